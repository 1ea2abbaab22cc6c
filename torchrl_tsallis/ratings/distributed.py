"""Sums over the processes of data-parallel training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, distributed

#: Sums each of several tensors over all processes.
GlobalSum = Callable[..., list[Tensor]]


def global_sum(*values: Tensor, group: Any = None) -> list[Tensor]:
    """Sums tensors over the processes of a group, by one all-reduce in float64: counts stay exact.

    Args:
        values: of any shape; the same shapes in every process.
        group: ``torch.distributed`` process group. Default: all processes.

    Returns:
        The sums in the shape and data type of each value; counts (integers) come back as float64. They are the same in
        every process, to the last bit.

    Examples:
        >>> from tempfile import mkdtemp
        >>> distributed.init_process_group("gloo", f"file://{mkdtemp()}/store", rank=0, world_size=1)
        >>> global_sum(torch.tensor([1.0, 2.0]), torch.tensor(3))
        [tensor([1., 2.]), tensor(3., dtype=torch.float64)]
        >>> distributed.destroy_process_group()
    """
    flat = torch.cat([value.detach().reshape(-1).double() for value in values])
    distributed.all_reduce(flat, group=group)
    parts = flat.split([value.numel() for value in values])
    return [
        part.view(value.shape).to(value.dtype if value.is_floating_point() else part.dtype)
        for part, value in zip(parts, values, strict=True)
    ]


def num_processes(group: Any = None) -> int:
    """Number of processes of a group; 1 where ``torch.distributed`` was not initialised.

    Args:
        group: process group. Default: all processes.

    Returns:
        The number.

    Examples:
        >>> num_processes()
        1
    """
    if not distributed.is_available() or not distributed.is_initialized():
        return 1
    return distributed.get_world_size(group)
