"""A short video of a policy."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis._checks import check_path, shown
from torchrl_tsallis.evaluation.episodes import EnvFn, resolve
from torchrl_tsallis.evaluation.interface import ActionRule, begin, name_of, observation_shape, take
from torchrl_tsallis.evaluation.ownership import act, as_policy, left_as_found, own_copy
from torchrl_tsallis.evaluation.settings import positive_number, whole_number
from torchrl_tsallis.evaluation.video_files import WRITERS

_LOGGER = logging.getLogger(__name__)


def record_rollout(
    policy: Any,
    path: str | os.PathLike[str],
    *,
    env_fn: EnvFn,
    seconds: float = 6.0,
    fps: float = 15,
    seed: int = 10_000,
    size: tuple[int, int] | None = None,
    step_seconds: float | None = None,
) -> Path:
    """Records the start of an episode as ``.gif`` (needs pillow) or ``.mp4`` (needs imageio-ffmpeg).

    The episode is the one that :func:`~torchrl_tsallis.evaluation.evaluate_policies` runs with this seed, and the
    policy's mode and memory and the random numbers are left as they were. The video has the size that the
    environment renders; ``.mp4`` repeats the last column or row of an odd one, because H.264 needs an even size.

    Args:
        policy: observation -> action, an actor of TorchRL, or an actor's state, as for ``evaluate_policies``.
        path: file to write.
        env_fn: makes the environment, called with ``render_mode="rgb_array"``.
        seconds: longest duration (6); it ends with the episode.
        fps: frames a second (15); the video plays in real time.
        seed: of the episode (10000).
        size: width and height in pixels, for environments that read ``_render_width`` and ``_render_height`` as
            PyBullet's do. Default: what the environment renders.
        step_seconds: simulated time of a step, s. Default: that of the environment's ``metadata["render_fps"]``; where
            it has none, every step is one frame.

    Returns:
        The path.

    Raises:
        ImportError: if the format's package is missing.
        ValueError: if the suffix or a number is not supported, the environment does not render frames
            ``[height, width, 3]`` of uint8 and of one size, or an action is none.
        OSError: if the file cannot be written, or not completely; one that was there before is left as it was.

    Examples:
        >>> record_rollout(np.zeros_like, "robot.avi", env_fn="my_robot:make_env")
        Traceback (most recent call last):
        ...
        ValueError: cannot write 'robot.avi': use .gif or .mp4
    """
    target = Path(check_path("path", path))
    if target.suffix.lower() not in WRITERS:
        raise ValueError(f"cannot write {shown(str(path))}: use .gif or .mp4")
    module, package, write = WRITERS[target.suffix.lower()]
    seconds, fps, seed = positive_number("seconds", seconds), positive_number("fps", fps), whole_number("seed", seed, 0)
    if step_seconds is not None:
        positive_number("step_seconds", step_seconds)
    if target.suffix.lower() == ".gif" and fps > 100:
        raise ValueError(f"a .gif has at most 100 frames a second, got fps={fps:g}: choose less, or .mp4")
    if size is not None:
        if not isinstance(size, (tuple, list)) or len(size) != 2:
            raise ValueError(f"size must be (width, height) in pixels, got {shown(size)}")
        size = whole_number("width", size[0], 16), whole_number("height", size[1], 16)
    if importlib.util.find_spec(module) is None:
        raise ImportError(f"writing {target.suffix} needs {package}: pip install {package}")
    own = as_policy("policy", policy)
    with left_as_found([own]):
        env = _make(resolve(env_fn))
        try:
            frames = _frames(own_copy(own), env, seconds, fps, seed, size, step_seconds)
        finally:
            getattr(env, "close", lambda: None)()
    write(frames, target, fps)
    return target


def _make(env_fn: Callable[..., Any]) -> Any:
    """Makes an environment that renders images."""
    try:
        return env_fn(render_mode="rgb_array")
    except TypeError as error:
        if "render_mode" not in str(error):
            raise
        name = getattr(env_fn, "__name__", repr(env_fn))
        raise TypeError(f"env_fn {name} must take render_mode='rgb_array' and hand it to the environment") from error


def _frames(
    policy: Callable[[Any], Any],
    env: Any,
    seconds: float,
    fps: float,
    seed: int,
    size: tuple[int, int] | None,
    step_seconds: float | None,
) -> list[np.ndarray]:
    """Runs the episode and draws frame k at the first step at or after k / fps seconds."""
    if size is not None:
        # PyBullet's environments read the image's size from these attributes.
        bare = getattr(env, "unwrapped", env)
        bare._render_width, bare._render_height = size
    if step_seconds is None:
        rate = (getattr(env, "metadata", None) or {}).get("render_fps") or fps
        step_seconds = 1 / positive_number("metadata['render_fps']", rate)
    rule, shape = ActionRule(env), observation_shape(env)
    begin(env, seed, shape)  # as make_environment: PyBullet's first episode differs
    observation = begin(env, seed, shape)
    batched = getattr(policy, "batched", False)
    frames: list[np.ndarray] = []
    steps, done = 0, False
    while not done and steps * step_seconds < seconds:
        if steps * step_seconds >= len(frames) / fps:
            frames.append(_checked_frame(env, frames))
        action = act(policy, np.array([observation]))[0] if batched else act(policy, observation)
        legal = rule.legal([action])
        if legal is None:
            raise ValueError(f"step {steps}: {rule.fault(action)}")
        observation, _, terminated, truncated = take(env, legal[0], shape)
        steps, done = steps + 1, terminated or truncated
    height, width = frames[0].shape[:2]
    if size is not None and size != (width, height):
        _LOGGER.warning("%s renders %d x %d pixels, not the size %d x %d", name_of(env), width, height, *size)
    return frames


def _checked_frame(env: Any, before: list[np.ndarray]) -> np.ndarray:
    """Renders a frame ``[height, width, 3]`` of uint8, which has the size of the ones before."""
    given, name = env.render(), name_of(env)
    if given is None:
        raise ValueError(f"{name} renders None: env_fn must hand render_mode='rgb_array' to the environment")
    frame = np.asarray(given) if isinstance(given, np.ndarray) else np.asarray(None)
    if frame.ndim == 2:
        frame = frame[..., None]
    if frame.ndim != 3 or frame.shape[2] not in (1, 3, 4) or frame.dtype != np.uint8 or not frame.size:
        found = (
            f"{given.dtype} of shape {given.shape}" if isinstance(given, np.ndarray) else f"a {type(given).__name__}"
        )
        raise ValueError(
            f"{name} renders {found}, needed are arrays [height, width, 3] of uint8: have the environment's render "
            "return such, such as np.rint(255 * image).astype(np.uint8) of an image in [0, 1]"
        )
    frame = np.repeat(frame, 3, 2) if frame.shape[2] == 1 else frame[..., :3].copy()
    if before and frame.shape != before[0].shape:
        sizes = " and ".join(f"{part.shape[1]} x {part.shape[0]}" for part in (before[0], frame))
        raise ValueError(f"{name} renders frames of {sizes} pixels in one episode: a video needs one size")
    return frame
