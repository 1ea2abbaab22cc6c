"""The paper's network and the density of a diagonal normal, forward and backward, as functions that autograd knows."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

Plain = Callable[..., tuple[Tensor, Tensor]]


@lru_cache(maxsize=64)
def _integers(*values: int) -> Any:
    return (ctypes.c_int64 * len(values))(*values)


@lru_cache(maxsize=64)
def _reals(*values: float) -> Any:
    return (ctypes.c_float * len(values))(*values)


def pointers(tensors: Sequence[Tensor]) -> Any:
    """The addresses of tensors as a C array."""
    return (ctypes.c_void_p * len(tensors))(*[x.data_ptr() for x in tensors])


def _address(x: Tensor | None) -> int | None:
    return None if x is None else x.data_ptr()


def fits(*tensors: Tensor) -> bool:
    """Whether the kernels take these tensors: float32 numbers in a CPU's memory."""
    return all(x.dtype is torch.float32 and x.device.type == "cpu" for x in tensors)


class _Network(torch.autograd.Function):
    """Mean and scale of the paper's network; keeps the normalised values of each layer for the gradient."""

    @staticmethod
    def forward(
        ctx: Any, library: Any, plain: Plain, setting: Any, x: Tensor, *params: Tensor
    ) -> tuple[Tensor, Tensor]:
        sizes, eps, min_scale = setting
        members = len(x) if x.ndim == 3 else 1
        rows, linears, dims = x.shape[-2], len(sizes) - 1, sizes[-1] // 2
        loc, scale = x.new_empty(*x.shape[:-1], dims), x.new_empty(*x.shape[:-1], dims)
        grad = any(ctx.needs_input_grad)
        integers = _integers(*sizes)
        kept = x.new_empty(members * library.tsallis_kept_size(rows, linears, integers)) if grad else None
        x, params = x.contiguous(), tuple(p.contiguous() for p in params)
        ctx.call = (members, rows, linears, integers)
        library.tsallis_network_forward(
            *ctx.call, x.data_ptr(), pointers(params), _reals(*eps), min_scale, loc.data_ptr(), scale.data_ptr(),
            _address(kept), torch.get_num_threads(),
        )  # fmt: skip
        if kept is not None:
            ctx.save_for_backward(x, kept, *params)
            ctx.set_materialize_grads(False)
            ctx.library, ctx.plain, ctx.eps = library, plain, eps
        return loc, scale

    @staticmethod
    def backward(ctx: Any, by_loc: Tensor | None, by_scale: Tensor | None) -> tuple[Tensor | None, ...]:
        x, kept, *params = ctx.saved_tensors
        needed = ctx.needs_input_grad[4:]
        if by_loc is None and by_scale is None:
            return (None,) * (4 + len(params))
        if torch.is_grad_enabled():  # a gradient of it is wanted: of the plain formula, which autograd knows
            both = zip(ctx.plain(x, params), (by_loc, by_scale), strict=True)
            outs, grads_of = zip(*[(out, grad) for out, grad in both if grad is not None], strict=True)
            wanted = [p for p, need in zip(params, needed, strict=True) if need]
            found = iter(torch.autograd.grad(outs, wanted, grads_of, create_graph=True, allow_unused=True))
            return (*(None,) * 4, *(next(found) if need else None for need in needed))
        by_loc = None if by_loc is None else by_loc.contiguous()
        by_scale = None if by_scale is None else by_scale.contiguous()
        flat = x.new_empty(sum(p.numel() for p in params))  # one piece of memory for all of the gradients
        grads = [g.view(p.shape) for g, p in zip(flat.split([p.numel() for p in params]), params, strict=True)]
        ctx.library.tsallis_network_backward(
            *ctx.call, x.data_ptr(), pointers(params), _reals(*ctx.eps), kept.data_ptr(), _address(by_loc),
            _address(by_scale), pointers(grads), torch.get_num_threads(),
        )  # fmt: skip
        return (*(None,) * 4, *(g if need else None for g, need in zip(grads, needed, strict=True)))


def network(
    library: Any,
    plain: Plain,
    sizes: Sequence[int],
    eps: Sequence[float],
    min_scale: float,
    x: Tensor,
    params: Sequence[Tensor],
) -> tuple[Tensor, Tensor]:
    """Mean and scale of a network of hidden layers with RMSNorm and Squish and a normal's head.

    Args:
        library: the kernels.
        plain: the same as a function of ``x`` and ``params``, for gradients of gradients.
        sizes: of the input, the hidden layers and the last layer's output, 2 A.
        eps: epsilon of each RMSNorm.
        min_scale: of the head.
        x: ``[N, in]``, or of members ``[S, N, in]``, without gradient.
        params: weight, bias and norm's weight of each hidden layer, weight and bias of the last.

    Returns:
        Mean and scale, ``[N, A]`` each, or ``[S, N, A]``.
    """
    setting = (tuple(sizes), tuple(eps), min_scale)
    out: tuple[Tensor, Tensor] = _Network.apply(library, plain, setting, x, *params)
    return out


class _LogDensity(torch.autograd.Function):
    """Log-density of a diagonal normal, -inf without gradient where an action is infinitely far away."""

    @staticmethod
    def forward(ctx: Any, library: Any, plain: Any, loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
        loc, scale, action = loc.contiguous(), scale.contiguous(), action.contiguous()
        out = loc.new_empty(loc.shape[:-1])
        library.tsallis_log_density(
            out.numel(), loc.shape[-1], loc.data_ptr(), scale.data_ptr(), action.data_ptr(), out.data_ptr()
        )
        ctx.save_for_backward(loc, scale, action)
        ctx.library, ctx.plain = library, plain
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        loc, scale, action = ctx.saved_tensors
        need = ctx.needs_input_grad[2:4]
        if torch.is_grad_enabled():
            wanted = [x for x, n in zip((loc, scale), need, strict=True) if n]
            found = iter(torch.autograd.grad(ctx.plain(loc, scale, action), wanted, grad, create_graph=True))
            return (None, None, *(next(found) if n else None for n in need), None)
        grad = grad.contiguous()
        by_loc, by_scale = torch.empty_like(loc), torch.empty_like(scale)
        ctx.library.tsallis_log_density_gradient(
            grad.numel(), loc.shape[-1], loc.data_ptr(), scale.data_ptr(), action.data_ptr(), grad.data_ptr(),
            by_loc.data_ptr(), by_scale.data_ptr(),
        )  # fmt: skip
        return None, None, by_loc if need[0] else None, by_scale if need[1] else None, None


def log_density(library: Any, plain: Any, loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
    """Log-density of a diagonal normal, ``[*B]``.

    Args:
        library: the kernels.
        plain: the same as a function of the other three, for gradients of gradients.
        loc: ``[*B, A]``.
        scale: ``[*B, A]``.
        action: ``[*B, A]``, without gradient.
    """
    out: Tensor = _LogDensity.apply(library, plain, loc, scale, action)
    return out
