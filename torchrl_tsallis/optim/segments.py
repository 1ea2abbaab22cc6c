"""Layout of many tensors in one flat vector, with one scalar per tensor or per ensemble member's tensor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["Segments"]


_DENSE = 2**18  # entries of the averaging matrix, 1 MB in float32


class Segments:
    """Flat layout of tensors of one data type and device.

    Each tensor of shape ``[*B, *E]`` gives ``prod(B)`` segments of ``prod(E)`` entries; scalars of all segments are
    stacked in one vector ``[S]``, so that nothing has to be computed tensor by tensor.

    Args:
        tensors: the tensors; none of them is kept.
        batch_dims: number of leading ensemble dimensions, ``len(B)``. Default: 0.

    Raises:
        ValueError: if a tensor has fewer than ``batch_dims`` dimensions.

    Examples:
        >>> x = [torch.ones(2, 3), torch.arange(2.0)]
        >>> segments = Segments(x)
        >>> segments.mean(segments.flatten(x))
        tensor([1.0000, 0.5000])
        >>> segments.expand(torch.tensor([1.0, 2.0]))
        tensor([1., 1., 1., 1., 1., 1., 2., 2.])
    """

    def __init__(self, tensors: Sequence[Tensor], batch_dims: int = 0) -> None:
        for x in tensors:
            if x.ndim < batch_dims:
                raise ValueError(
                    f"a tensor of shape {tuple(x.shape)} has no {batch_dims} leading ensemble dimensions; "
                    "put it in a group of its own with batch_dims=0"
                )
        self.batch_dims = batch_dims
        self.shapes = [x.shape for x in tensors]
        self.batch_shapes = [x.shape[:batch_dims] for x in tensors]
        self.sizes = [x.numel() for x in tensors]
        self.counts = [math.prod(b) for b in self.batch_shapes]
        self.num_segments = sum(self.counts)
        lengths = [n // b for n, b in zip(self.sizes, self.counts, strict=True) for _ in range(b)]
        device = tensors[0].device
        self.reciprocals = torch.tensor([1 / max(n, 1) for n in lengths], dtype=torch.float64, device=device)
        self.ids = torch.repeat_interleave(torch.tensor(lengths, device=device))
        self.single = all(n == 1 for n in lengths)  # a segment is a scalar: nothing to average or to repeat
        # Few segments on the CPU: one product with this matrix costs a third of one sum per tensor.
        self.averages: Tensor | None = None
        if device.type == "cpu" and not self.single and self.num_segments * len(self.ids) <= _DENSE:
            segments = torch.arange(self.num_segments, device=device).unsqueeze(-1)
            self.averages = ((segments == self.ids) * self.reciprocals.unsqueeze(-1)).to(tensors[0].dtype)

    def flatten(self, tensors: Sequence[Tensor]) -> Tensor:
        """Copies tensors of the layout's shapes into one vector ``[N]``."""
        return torch.cat([x.reshape(-1) for x in tensors])

    def views(self, flat: Tensor) -> list[Tensor]:
        """Views of a vector ``[N]`` in the tensors' shapes ``[*B, *E]``."""
        return [x.view(s) for x, s in zip(flat.split(self.sizes), self.shapes, strict=True)]

    def buffer(self, like: Tensor) -> tuple[Tensor, list[Tensor]]:
        """An uninitialised vector ``[N]``, and its views in the tensors' shapes."""
        flat = torch.empty(len(self.ids), dtype=like.dtype, device=like.device)
        return flat, self.views(flat)

    def scalar_views(self, scalars: Tensor) -> list[Tensor]:
        """Views of stacked scalars ``[S]``, of shape ``[*B]`` per tensor."""
        return [x.view(b) for x, b in zip(scalars.split(self.counts), self.batch_shapes, strict=True)]

    def expand(self, scalars: Tensor) -> Tensor:
        """Repeats stacked scalars ``[S]`` over the entries of their segments, ``[N]``."""
        if self.single:
            return scalars
        if self.num_segments == len(self.sizes):
            return scalars.index_select(0, self.ids)
        flat = scalars.new_empty(len(self.ids))  # of members: long rows, and a third of the time
        for x, rows in zip(flat.split(self.sizes), scalars.split(self.counts), strict=True):
            x.view(len(rows), -1).copy_(rows.unsqueeze(-1))
        return flat

    def mean(self, flat: Tensor) -> Tensor:
        """Mean over each segment of a vector ``[N]``, stacked, ``[S]``."""
        if self.single:
            return flat
        if self.averages is not None and self.averages.dtype == flat.dtype and self.averages.device == flat.device:
            means = self.averages.mv(flat)
            if math.isfinite(means.sum().item()):  # else 0 * inf may have carried one segment's trouble to the others
                return means
        parts = flat.split(self.sizes)
        if self.num_segments == len(parts):  # a full sum costs half of a sum over a dimension
            return torch.stack([x.sum() for x in parts]) * self.reciprocals.to(flat.dtype)
        sums = torch.cat([x.view(c, -1).sum(-1) for x, c in zip(parts, self.counts, strict=True)])
        return sums * self.reciprocals.to(flat.dtype)
