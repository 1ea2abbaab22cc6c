from __future__ import annotations

import logging
import subprocess

import numpy as np
import pytest

from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation.video import record_rollout
from torchrl_tsallis.evaluation.video_files import write_mp4


def still(observation):
    return np.zeros(8)


def nothing(observation):
    return np.zeros(2)


def test_bad_arguments():
    with pytest.raises(ValueError, match="use .gif or .mp4"):
        record_rollout(still, "x.png", env_fn=make_ant)
    with pytest.raises(ValueError, match="fps=0"):
        record_rollout(still, "x.gif", env_fn=make_ant, fps=0)


@pytest.mark.filterwarnings("ignore")
def test_gif_frames_and_size(tmp_path):
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("pybullet")
    ant = {"env_fn": make_ant, "step_seconds": 0.0165}
    path = record_rollout(still, tmp_path / "ant.gif", seconds=0.3, fps=10, size=(64, 48), **ant)
    with image.open(path) as gif:
        # frames at 0, 0.1 and 0.2 s
        assert (gif.size, gif.n_frames) == ((64, 48), 3)


def picture(height, width, value):
    """A frame whose left half is red and whose brightness tells which one it is."""
    frame = np.full((height, width, 3), value, np.uint8)
    frame[:, : width // 2, 0] = 250
    return frame


def read(path):
    """The frames of a video, ``[T, height, width, 3]``."""
    if path.suffix == ".gif":
        from PIL import Image, ImageSequence

        with Image.open(path) as gif:
            return np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(gif)])
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-f", "image2pipe", "-c:v", "ppm", "-"]
    data = subprocess.run(command, capture_output=True, check=True).stdout
    _, size, _, _ = data.split(b"\n", 3)
    width, height = map(int, size.split())
    frames = np.frombuffer(data, np.uint8).reshape(-1, len(b"P6\n255\n\n" + size) + 3 * width * height)
    return frames[:, -3 * width * height :].reshape(-1, height, width, 3)


@pytest.mark.parametrize("size", [(48, 64), (47, 64), (48, 65), (33, 17), (240, 320)])
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_what_was_rendered_is_read_back_whatever_its_size(suffix, size, make_env, tmp_path, caplog):
    pytest.importorskip({".gif": "PIL", ".mp4": "imageio_ffmpeg"}[suffix])
    env_fn = make_env(render=lambda self: picture(*size, 30 + 40 * self.t), steps=5)
    path = record_rollout(nothing, tmp_path / f"a{suffix}", env_fn=env_fn, size=(320, 240))
    frames = read(path).astype(float)
    height, width = size
    even = (height + height % 2, width + width % 2) if suffix == ".mp4" else size
    assert frames.shape == (5, *even, 3)
    for t, frame in enumerate(frames):
        assert np.abs(frame[:height, :width] - picture(*size, 30 + 40 * t)).mean() < 6
    assert (f"Small renders {width} x {height} pixels" in caplog.text) == (size != (240, 320))


@pytest.mark.parametrize(
    "render",
    [
        lambda self: picture(48, 64, 9)[..., 1],
        lambda self: picture(48, 64, 9)[..., 1:2],
        lambda self: np.concatenate([picture(48, 64, 9), picture(48, 64, 9)[..., :1]], -1),
    ],
)
def test_grey_and_transparent_frames_are_drawn(render, make_env, tmp_path):
    pytest.importorskip("PIL")
    frames = read(record_rollout(nothing, tmp_path / "a.gif", env_fn=make_env(render=render)))
    assert frames.shape[1:] == (48, 64, 3) and (frames[:, :, 40:] == 9).all()


def _growing(self):
    return np.zeros((48 + self.t, 64, 3), np.uint8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"render": lambda self: None}, "Small renders None: env_fn must hand render_mode"),
        ({"render": lambda self: np.zeros((48, 64, 3))}, r"float64 of shape \(48, 64, 3\).*np.rint"),
        ({"render": lambda self: np.zeros((48, 64, 3), np.int64)}, "int64"),
        (
            {"render": lambda self: np.zeros((3, 48, 64), np.uint8)},
            r"shape \(3, 48, 64\), needed .*\[height, width",
        ),
        ({"render": lambda self: np.zeros((0, 64, 3), np.uint8)}, r"shape \(0, 64, 3\)"),
        ({"render": lambda self: [np.zeros((48, 64, 3), np.uint8)]}, "renders a list"),
        ({"render": lambda self: "a frame"}, "renders a str"),
        ({"render": _growing}, "frames of 64 x 48 and 64 x 49 pixels in one episode"),
        ({"step": lambda self, action: (1, 2)}, "step of Small gave 2 values"),
        ({"reset": lambda self, seed=None: 1}, "reset of Small gave a int"),
        ({"metadata": {"render_fps": 0.0, "x": 1}}, None),
        ({"metadata": {"render_fps": -3}}, "render_fps"),
    ],
)
def test_what_is_no_video_names_environment_and_fix(changes, message, make_env, tmp_path):
    pytest.importorskip("PIL")
    env_fn = make_env(**changes)
    if message is None:
        record_rollout(nothing, tmp_path / "a.gif", env_fn=env_fn)
        return
    with pytest.raises(ValueError, match=message):
        record_rollout(nothing, tmp_path / "a.gif", env_fn=env_fn)
    assert not list(tmp_path.iterdir()) and env_fn.closed == 1


def test_what_makes_no_pictures_is_told_to(make_env, tmp_path):
    pytest.importorskip("PIL")
    with pytest.raises(TypeError, match="must take render_mode='rgb_array'"):
        record_rollout(nothing, tmp_path / "a.gif", env_fn=lambda: None)
    with pytest.raises(ValueError, match=r"step 0: need a finite action of shape \(2,\)"):
        record_rollout(still, tmp_path / "a.gif", env_fn=make_env())


def test_a_missing_package_is_named_before_anything_runs(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for suffix, package in ((".gif", "pillow"), (".mp4", "imageio-ffmpeg"), (".MP4", "imageio-ffmpeg")):
        with pytest.raises(ImportError, match=f"needs {package}: pip install {package}"):
            record_rollout(nothing, tmp_path / f"a{suffix}", env_fn="no_such:module")


def test_time_is_the_environment_s_or_a_step_a_frame(make_env, tmp_path):
    pytest.importorskip("PIL")
    # 0.5 s a step: 4 frames a second repeat no step; 1 frame a second skips every other one
    for metadata, options, count in (
        ({}, {"fps": 4}, 8),
        ({"render_fps": 2}, {"fps": 4}, 8),
        ({"render_fps": 2}, {"fps": 1}, 4),
        ({"render_fps": 99}, {"fps": 1, "step_seconds": 0.5}, 4),
    ):
        env_fn = make_env(metadata=metadata, steps=8, render=lambda self: picture(48, 64, 20 * self.t))
        frames = read(record_rollout(nothing, tmp_path / "a.gif", env_fn=env_fn, seconds=60, **options))
        assert len(frames) == count


def test_a_video_s_episode_is_the_evaluation_s(make_env, tmp_path):
    pytest.importorskip("PIL")
    from torchrl_tsallis.evaluation.episodes import run_episode

    class Batched:
        batched = True

        def __call__(self, observations):
            return observations / 20

    first, second = make_env(), make_env()
    record_rollout(Batched(), tmp_path / "a.gif", env_fn=first, seed=10)
    run_episode(Batched(), second, 10)
    assert len(first.actions_seen) == 3
    np.testing.assert_array_equal(first.actions_seen, second.actions_seen)


def test_a_file_that_ffmpeg_left_incomplete_is_not_published(monkeypatch, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "a.mp4"
    path.write_bytes(b"good")
    frames = [picture(48, 64, 20 * t) for t in range(5)]

    def count(found):
        def count_frames_and_secs(file):
            if found is None:
                raise RuntimeError("unable to read")
            return found, 1.0

        return count_frames_and_secs

    for found, message in ((3, "wrote 3 of 5 frames"), (0, "wrote 0 of 5"), (None, "cannot be read")):
        with monkeypatch.context() as patch:
            patch.setattr(imageio_ffmpeg, "count_frames_and_secs", count(found))
            with pytest.raises(OSError, match=f"cannot write .*a.mp4.*{message}"):
                write_mp4(frames, path, 15)
        assert path.read_bytes() == b"good" and len(list(tmp_path.iterdir())) == 1
    write_mp4(frames, path, 15)
    assert len(read(path)) == 5


def test_the_size_that_an_environment_takes_is_no_warning(make_env, tmp_path, caplog):
    pytest.importorskip("PIL")

    def render(self):
        return picture(self._render_height, self._render_width, 9)

    with caplog.at_level(logging.WARNING):
        path = record_rollout(nothing, tmp_path / "a.gif", env_fn=make_env(render=render), size=(40, 20))
    assert read(path).shape[1:3] == (20, 40) and not caplog.text
