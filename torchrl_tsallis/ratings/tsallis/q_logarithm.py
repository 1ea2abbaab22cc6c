"""The q-logarithm and its inverse, of numbers given by their natural logarithm."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

#: Exponents are cut here: ``exp(64)`` still sums over 1e10 samples in float32 without overflowing.
MAX_EXPONENT = 64.0
_SERIES_TERMS = 20


def as_like(value: float | Tensor, reference: Tensor) -> Tensor:
    """``value`` as a tensor of the reference's dtype and device."""
    if isinstance(value, Tensor):
        return value.to(reference)
    return torch.full((), value, dtype=reference.dtype, device=reference.device)


def _phi1_derivative(z: Tensor) -> Tensor:
    """d/dz of (exp(z) - 1) / z, by its series near 0 where the closed form cancels."""
    near = z.abs() < 1
    small = torch.where(near, z, 0.0)
    series = torch.zeros_like(z)
    for k in range(_SERIES_TERMS, 0, -1):  # sum over k >= 1 of k z^(k-1) / (k+1)!
        series = series * small + k / math.factorial(k + 1)
    large = torch.where(near, 1.0, z)
    return torch.where(near, series, (large * large.exp() - large.expm1()) / large.square())


class _QLogarithm(torch.autograd.Function):
    """q-logarithm of exp(log_x), with gradients that do not cancel (autograd's own would lose exp(z) << 1)."""

    generate_vmap_rule = True

    @staticmethod
    def forward(log_x: Tensor, q: Tensor) -> Tensor:
        u = 1 - q
        z = (u * log_x).clamp(max=MAX_EXPONENT)
        return torch.where(u == 0, log_x, z.expm1() / torch.where(u == 0, 1.0, u))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        log_x, q = ctx.saved_tensors
        z = ((1 - q) * log_x).clamp(max=MAX_EXPONENT)
        by_log_x = grad * z.exp() if ctx.needs_input_grad[0] else None
        by_q = None
        if ctx.needs_input_grad[1]:
            # Past the cut the value is constant in z, so that its slope in u = 1 - q is -expm1(z) / u^2.
            u = 1 - q
            cut = u * log_x >= MAX_EXPONENT
            inside = log_x.square() * _phi1_derivative(torch.where(cut, 0.0, z))
            outside = -z.expm1() / torch.where(cut, u, 1.0).square()
            by_q = (-grad * torch.where(cut, outside, inside)).sum_to_size(q.shape)
        return by_log_x, by_q


def ln_q(log_x: Tensor, q: float | Tensor) -> Tensor:
    r"""The q-logarithm (eq. 3) of a number given by its natural logarithm.

    .. math:: \ln_q x = \frac{x^{1-q} - 1}{1-q}, \qquad \ln_1 x = \ln x

    Args:
        log_x: natural logarithm of x, ``[*B]``.
        q: Tsallis index, a number or a tensor that broadcasts against ``log_x``.

    Returns:
        ``ln_q(x)``, ``[*B]``. The exponent is cut at :data:`MAX_EXPONENT`; the gradient with respect to ``log_x`` is
        the rating ``x^(1-q)`` of eq. 7.

    Examples:
        >>> ln_q(torch.tensor([0.0, 2.0]).log(), 0.5)
        tensor([-2.0000,  0.8284])
        >>> ln_q(torch.tensor(3.0), 1.0)
        tensor(3.)
    """
    q = as_like(q, log_x)
    # Broadcast outside of the Function: its backward then sees log_x in the output's shape.
    return _QLogarithm.apply(log_x.expand(torch.broadcast_shapes(log_x.shape, q.shape)), q)


def exp_q(y: Tensor, q: float | Tensor) -> Tensor:
    r"""The q-exponential, the inverse of :func:`ln_q`: ``exp_q(ln_q(x), q) = x``.

    .. math:: \exp_q(y) = [1 + (1-q) y]_+^{1/(1-q)}, \qquad \exp_1(y) = e^y

    Args:
        y: argument, ``[*B]``.
        q: Tsallis index, a number or a tensor that broadcasts against ``y``.

    Returns:
        ``exp_q(y)``, ``[*B]``; 0 below the cut-off ``y = -1/(1-q)``.

    Examples:
        >>> exp_q(torch.tensor([-2.0, 0.0, 2.0]), 0.5)
        tensor([0., 1., 4.])
    """
    u = 1 - as_like(q, y)
    plain = u == 0
    base = u * y
    alive = base > -1
    log_x = torch.where(alive, base, 0.0).log1p() / torch.where(plain, 1.0, u)
    log_x = torch.where(plain, y, log_x).clamp(max=MAX_EXPONENT)
    return torch.where(plain | alive, log_x.exp(), 0.0)
