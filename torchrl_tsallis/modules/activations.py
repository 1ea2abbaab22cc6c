"""Squareplus and Squish: smooth algebraic activations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tsallis.modules.numerics import is_traced, widened


def squareplus(x: Tensor) -> Tensor:
    r"""Algebraic softplus, :math:`(x + \sqrt{x^2 + 4}) / 2` (Barron, arXiv 2112.11687).

    For negative x the equal form :math:`2 / (\sqrt{x^2+4} - x)` is used, which does not cancel: the result is positive
    for every finite x that float32 can square. Half precision is computed in float32.

    Args:
        x: any shape.

    Returns:
        A positive number for each entry, of the same data type.

    Examples:
        >>> import torch
        >>> squareplus(torch.tensor([0.0, -1e4]))
        tensor([1.0000e+00, 1.0000e-04])
    """
    given, x = x.dtype, widened(x)
    root = (x.square() + 4).sqrt()
    # |x| rather than -x: the branch that is not taken must stay finite, or its gradient becomes 0 * inf.
    return ((x + root) / 2).where(x >= 0, 2 / (root + x.abs())).to(given)


class _Squish(torch.autograd.Function):
    """Squish and its share ``s = x / sqrt(x^2 + 4)``, in a third of the passes over memory that autograd needs."""

    @staticmethod
    def forward(x: Tensor) -> tuple[Tensor, Tensor]:
        s = torch.addcmul(x.new_full((), 4.0), x, x).rsqrt_().mul_(x)
        return torch.addcmul(x, x, s).mul_(0.5), s

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(*inputs, output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> Tensor:  # (1 + 2 s - s^3) / 2
        x, s = ctx.saved_tensors
        if torch.is_grad_enabled():  # for a second derivative s is a function of x
            s = x * (x.square() + 4).rsqrt()
            return grad * (0.5 + s * (1 - 0.5 * s.square()))
        return torch.addcmul(s, s, s.square(), value=-0.5).add_(0.5).mul_(grad)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None], x: Tensor) -> tuple[Any, tuple[int | None, int | None]]:
        return _Squish.apply(x), (in_dims[0], in_dims[0])


def squish(x: Tensor) -> Tensor:
    r"""Swish with an algebraic sigmoid, :math:`x (1 + x / \sqrt{x^2 + 4}) / 2` (method of section V-B).

    The sigmoid is squareplus' derivative. The paper only cites Squish; this form is this project's reading. Half
    precision is computed in float32.

    Args:
        x: any shape.

    Returns:
        The activation, same shape and data type.

    Examples:
        >>> import torch
        >>> squish(torch.tensor([0.0, 1.5]))
        tensor([0.0000, 1.2000])
    """
    given, x = x.dtype, widened(x)
    y: Tensor = x * (1 + x * (x.square() + 4).rsqrt()) / 2 if is_traced() else _Squish.apply(x)[0]
    return y.to(given)


class Squish(nn.Module):
    """:func:`squish` as a module.

    Examples:
        >>> import torch
        >>> Squish()(torch.tensor(1.5))
        tensor(1.2000)
    """

    stackable = True

    def forward(self, x: Tensor) -> Tensor:
        """Applies the activation, any shape."""
        return squish(x)
