"""Frames to video files, which are complete or not written at all."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from torchrl_tsallis.jobs import atomic_path

Frames = Sequence[np.ndarray]


def write_gif(frames: Frames, path: str | os.PathLike[str], fps: float) -> None:
    """Writes an animation that repeats.

    Args:
        frames: ``[height, width, 3]`` of uint8, all of one size.
        path: file to write.
        fps: frames a second.

    Raises:
        OSError: if the file cannot be written; one that was there before is left as it was.
    """
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    options = {"duration": round(1000 / fps), "loop": 0, "optimize": True}
    with atomic_path(path) as temporary:
        images[0].save(temporary, format="GIF", save_all=True, append_images=images[1:], **options)


def write_mp4(frames: Frames, path: str | os.PathLike[str], fps: float) -> None:
    """Writes an H.264 video, and counts its frames before it is published.

    H.264 as players take it has an even width and height: of odd ones, the last column or row is repeated.

    Args:
        frames: ``[height, width, 3]`` of uint8, all of one size.
        path: file to write.
        fps: frames a second.

    Raises:
        OSError: if the file cannot be written or is not complete; one that was there before is left as it was.
    """
    import imageio_ffmpeg

    height, width = frames[0].shape[:2]
    even = [(0, height % 2), (0, width % 2), (0, 0)]
    size = f"{width + width % 2}x{height + height % 2}"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:.6g}", "-i", "-"]
    video = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-f", "mp4"]
    with atomic_path(path) as temporary:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *raw, *video, f"file:{temporary}"]
        data = b"".join(np.pad(frame, even, "edge").tobytes() for frame in frames)
        done = subprocess.run(command, input=data, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {done.returncode}"]
            raise OSError(errno.EIO, f"ffmpeg failed: {said[-1].rpartition('] ')[2]}")
        _check(temporary, len(frames))


def _check(path: Path, frames: int) -> None:
    """Compares the file with what was to be written: ffmpeg also ends well where the disk was full."""
    import imageio_ffmpeg

    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (RuntimeError, OSError, ValueError) as error:
        raise OSError(errno.EIO, "ffmpeg left a file that cannot be read, as on a full disk") from error
    if found != frames:
        raise OSError(errno.EIO, f"ffmpeg wrote {found} of {frames} frames, as on a full disk")


#: By suffix: the module that is needed, the package it is in, and the writer.
WRITERS: dict[str, tuple[str, str, Callable[[Frames, str | os.PathLike[str], float], None]]] = {
    ".gif": ("PIL", "pillow", write_gif),
    ".mp4": ("imageio_ffmpeg", "imageio-ffmpeg", write_mp4),
}
