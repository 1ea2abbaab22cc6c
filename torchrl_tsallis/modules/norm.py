"""RMSNorm with a cheaper gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.modules.numerics import is_traced, widened
from torchrl_tsallis.modules.settings import memory_for


class _RMSNorm(torch.autograd.Function):
    """Root mean square normalisation over the last dimension, with few passes over memory."""

    @staticmethod
    def forward(x: Tensor, weight: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:
        inverse = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
        inverse = inverse.square_().div_(x.shape[-1]).add_(eps).rsqrt_()
        unit = x * inverse
        return unit * weight, unit, inverse

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, float], output: tuple[Tensor, Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs[:2], *output[1:])
        ctx.eps = inputs[2]

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> tuple[Tensor, Tensor, None]:
        x, weight, unit, inverse = ctx.saved_tensors
        second = torch.is_grad_enabled()  # for a second derivative, unit and inverse are functions of x
        if second:
            inverse = (x.square().mean(-1, keepdim=True) + ctx.eps).rsqrt()
            unit = x * inverse
        product = grad * unit
        by_weight = product.sum_to_size(weight.shape)
        by_unit = grad * weight
        common = (product * weight if second else product.mul_(weight)).mean(-1, keepdim=True)
        if second:
            return (by_unit - unit * common) * inverse, by_weight, None
        return by_unit.addcmul_(unit, common, value=-1).mul_(inverse), by_weight, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], x: Tensor, weight: Tensor, eps: float) -> tuple[Any, Any]:
        x, weight = (
            v.movedim(d, 0) if d is not None else v.expand(info.batch_size, *v.shape)
            for v, d in zip((x, weight), in_dims, strict=False)
        )
        weight = weight.view(info.batch_size, *[1] * (x.ndim - weight.ndim), *weight.shape[1:])
        return _RMSNorm.apply(x, weight, eps), (0, 0, 0)


class RMSNorm(nn.RMSNorm):
    """``torch.nn.RMSNorm`` over the last dimension, whose gradient takes a third of the time on a CPU.

    Also takes stacked parameters, ``[S, size]``, for inputs ``[S, *B, size]``. Half precision is computed in float32.

    Args:
        size: length of the last dimension.
        eps: added to the mean square. Default: the epsilon of the data type that is computed in, as in
            ``torch.nn.RMSNorm``: float32's, also for half precision and under autocast.

    Raises:
        TypeError: for an argument of the wrong type.
        ValueError: for a size under 1, or an epsilon that is negative or not finite.

    Examples:
        >>> RMSNorm(2)(torch.tensor([3.0, 4.0])).detach()
        tensor([0.8485, 1.1314])
    """

    stackable = True

    def __init__(self, size: int, eps: float | None = None) -> None:
        size = int(check_number("size", size, low=1, integer=True))
        eps = None if eps is None else check_number("eps", eps, low=0)
        with memory_for(size=size):
            super().__init__(size, eps)

    def forward(self, x: Tensor) -> Tensor:
        """Normalises ``[*B, size]``."""
        given, x = x.dtype, widened(x)
        eps = torch.finfo(x.dtype).eps if self.eps is None else self.eps
        weight: Tensor = self.weight.to(x.dtype)
        if weight.ndim == 2:  # of stacked members, [S, size]
            weight = weight.view(len(weight), *[1] * (x.ndim - 2), -1)
        if is_traced():
            y: Tensor = x * (x.square().mean(-1, keepdim=True) + eps).rsqrt() * weight
        else:
            y = _RMSNorm.apply(x, weight, eps)[0]
        return y.to(given)
