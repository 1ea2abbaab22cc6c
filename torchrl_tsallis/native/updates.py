"""AdaTerm and CAT-soft over their flat states, two passes over memory each."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from torchrl_tsallis.native.network import fits, pointers


class Layout:
    """A layout of tensors in a flat vector, as the kernels take it.

    Args:
        sizes: numbers of entries, one a tensor.
        counts: numbers of segments, one a tensor.
    """

    def __init__(self, sizes: Sequence[int], counts: Sequence[int]) -> None:
        many = ctypes.c_int64 * len(sizes)
        lengths = [size // max(count, 1) for size, count in zip(sizes, counts, strict=True)]
        self.call = (len(sizes), many(*counts), many(*lengths))


def are_plain(*tensors: Tensor) -> bool:
    """Whether the kernels can go through these tensors from the first to the last number."""
    return fits(*tensors) and all(x.is_contiguous() for x in tensors)


def adaterm(
    library: Any,
    layout: Layout,
    params: Sequence[Tensor],
    grads: Sequence[Tensor],
    state: Mapping[str, Tensor],
    options: Sequence[float],
) -> None:
    """One step of AdaTerm, in place; what is not finite is left out.

    Args:
        library: the kernels.
        layout: of the tensors.
        params: the parameters.
        grads: their gradients.
        state: flat vectors ``exp_avg``, ``exp_avg_sq``, ``floor``, and stacked scalars ``nu``, ``step``, ``skipped``.
        options: lr, the three betas, eps, k and the weight decay.
    """
    flat = [state[name].data_ptr() for name in ("exp_avg", "exp_avg_sq", "floor", "nu", "step", "skipped")]
    library.tsallis_adaterm(
        *layout.call, pointers(params), pointers(grads), *flat, (ctypes.c_double * len(options))(*options)
    )


def cat_distance(
    library: Any, layout: Layout, source: Sequence[Tensor], target: Sequence[Tensor], scale: Tensor, distance: Tensor
) -> None:
    """The mean normalised squared distance of each segment of the parameters from its target, ``[S]``.

    Args:
        library: the kernels.
        layout: of the tensors.
        source: the parameters.
        target: their targets.
        scale: of the differences, a flat vector.
        distance: takes the result.
    """
    library.tsallis_cat_distance(
        *layout.call, pointers(source), pointers(target), scale.data_ptr(), distance.data_ptr()
    )


def cat(
    library: Any,
    layout: Layout,
    source: Sequence[Tensor],
    target: Sequence[Tensor],
    state: Mapping[str, Tensor],
    distance: Tensor,
    alone: Tensor | None,
    options: Sequence[float],
) -> None:
    """One update of CAT-soft, in place.

    Args:
        library: the kernels.
        layout: of the tensors.
        source: the parameters.
        target: their targets.
        state: the flat vector ``scale`` and the stacked scalars ``nu``.
        distance: of :func:`cat_distance`.
        alone: members that are not pulled, ``[members]`` bool; None for none of them.
        options: tau, strength, eps and k.
    """
    library.tsallis_cat(
        *layout.call, pointers(source), pointers(target), state["scale"].data_ptr(), state["nu"].data_ptr(),
        distance.data_ptr(), None if alone is None else alone.data_ptr(), (ctypes.c_double * 4)(*options),
    )  # fmt: skip
