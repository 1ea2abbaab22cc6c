"""Encoded images, which are decoded only where they are asked for."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_tsallis.data.readers.base import need, reading


def decode_images(encoded: Sequence[bytes], key: str, path: Path) -> np.ndarray:
    """Decodes JPEG or PNG images of one size, ``[T, H, W, C]`` uint8.

    Raises:
        ImportError: if pillow is missing.
        ValueError: if one is broken, or their sizes differ.
    """
    image = need("PIL.Image", path)
    out = []
    with reading(path, fix=f"leave {key!r} out"):
        for data in encoded:
            out.append(np.array(image.open(io.BytesIO(data))))
    if any(frame.shape != out[0].shape for frame in out):
        raise ValueError(f"images {key!r} of {str(path)!r} differ in size within an episode: leave them out")
    return np.stack(out)
