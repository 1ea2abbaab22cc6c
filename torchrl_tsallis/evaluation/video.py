"""A short video of a policy, drawn by PyBullet's software renderer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from torchrl_tsallis.evaluation.episodes import EnvFn, Policy, resolve
from torchrl_tsallis.evaluation.rollouts import DEFAULT_ENV
from torchrl_tsallis.jobs import atomic_path


def record_rollout(
    policy: Policy,
    path: str | os.PathLike[str],
    *,
    seconds: float = 6.0,
    fps: int = 15,
    seed: int = 10_000,
    size: tuple[int, int] = (320, 240),
    env_fn: EnvFn = DEFAULT_ENV,
    step_seconds: float = 0.0165,
) -> Path:
    """Records the start of an episode as ``.gif`` (needs pillow) or ``.mp4`` (needs imageio-ffmpeg).

    The episode is the one that :func:`~torchrl_tsallis.evaluation.evaluate_policies` runs with this seed.

    Args:
        policy: observation -> action, clipped to the action space.
        path: file to write.
        seconds: longest duration (6); it ends with the episode.
        fps: frames a second (15); the video plays in real time.
        seed: of the episode (10000).
        size: width and height in pixels (320 x 240).
        env_fn: makes the environment, called with ``render_mode="rgb_array"``.
        step_seconds: simulated time of a step (0.0165 s, the PyBullet locomotion robots).

    Returns:
        The path.

    Raises:
        ValueError: if the suffix or a number is not supported.
        OSError: if the file cannot be written.

    Examples:
        >>> record_rollout(np.zeros_like, "ant.avi")
        Traceback (most recent call last):
        ...
        ValueError: cannot write 'ant.avi': use .gif or .mp4
    """
    target = Path(path)
    if target.suffix not in (".gif", ".mp4"):
        raise ValueError(f"cannot write {str(target)!r}: use .gif or .mp4")
    if seconds <= 0 or fps <= 0 or step_seconds <= 0 or min(size) < 16:
        raise ValueError(f"seconds, fps, step_seconds and size must be positive: {seconds=}, {fps=}, {size=}")
    frames = _frames(policy, seconds, fps, seed, size, env_fn, step_seconds)
    with atomic_path(target) as temporary:
        if target.suffix == ".gif":
            from PIL import Image

            images = [Image.fromarray(frame) for frame in frames]
            images[0].save(
                temporary, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0, optimize=True
            )
        else:
            import imageio_ffmpeg

            writer = imageio_ffmpeg.write_frames(str(temporary), size, fps=fps, macro_block_size=2)
            writer.send(None)
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
            writer.close()
    return target


def _frames(
    policy: Policy,
    seconds: float,
    fps: int,
    seed: int,
    size: tuple[int, int],
    env_fn: EnvFn,
    step_seconds: float,
) -> list[np.ndarray]:
    """Runs the episode and draws frame k at the first step at or after k / fps seconds."""
    env = resolve(env_fn)(render_mode="rgb_array")
    try:
        # PyBullet's environments read the image's size from these attributes.
        env.unwrapped._render_width, env.unwrapped._render_height = size
        env.reset(seed=seed)
        observation, _ = env.reset(seed=seed)
        low, high = env.action_space.low, env.action_space.high
        frames: list[np.ndarray] = []
        steps, done = 0, False
        while not done and steps * step_seconds < seconds:
            if steps * step_seconds >= len(frames) / fps:
                frames.append(np.asarray(env.render(), dtype=np.uint8)[..., :3])
            action = np.clip(policy(observation), low, high).astype(low.dtype)
            observation, _, terminated, truncated, _ = env.step(action)
            steps, done = steps + 1, bool(terminated or truncated)
        return frames
    finally:
        env.close()
