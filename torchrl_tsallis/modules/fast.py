"""The paper's network as one step of autograd: fewer passes over memory than module by module, to the same bit.

Nothing here is a second network: :func:`network_of` recognises the one of
:func:`~torchrl_tsallis.modules.make_policy`, and gives it as a function of its parameters. What is not exactly that
network, or is being traced, transformed or run under autocast, is left to its modules, whose formulas are
:func:`plain_layers`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_tsallis import native
from torchrl_tsallis.modules.activations import Squish
from torchrl_tsallis.modules.linear import Linear
from torchrl_tsallis.modules.norm import RMSNorm
from torchrl_tsallis.modules.numerics import is_watched
from torchrl_tsallis.modules.policy import NormalHead
from torchrl_tsallis.native.network import fits
from torchrl_tsallis.native.network import network as native_network

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_NAMES = {Linear: ("weight", "bias"), RMSNorm: ("weight",)}


def _linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A linear layer on rows ``[N, in]``, or on those of members, ``[S, N, in]``."""
    return F.linear(x, weight, bias) if weight.ndim == 2 else torch.baddbmm(bias.unsqueeze(1), x, weight.mT)


def plain_layers(x: Tensor, params: Sequence[Tensor], eps: Sequence[float]) -> Tensor:
    """The layers as they are written in a book.

    Args:
        x: inputs, ``[N, in]``, or of members ``[S, N, in]``.
        params: weight and bias of a linear layer and weight of an RMSNorm, a hidden layer after the other; then weight
            and bias of the last layer. Of members, each has their dimension first.
        eps: epsilon of each RMSNorm.

    Returns:
        The last layer's output, ``[N, out]``, or ``[S, N, out]``.

    Examples:
        >>> one = torch.ones(1, 1)
        >>> plain_layers(3 * one, [one, 0 * one[0], one[0], one, 0 * one[0]], [0.0])  # squish(1) = (1 + 5**-0.5) / 2
        tensor([[0.7236]])
    """
    for index, e in enumerate(eps):
        weight, bias, scale = params[3 * index : 3 * index + 3]
        x = _linear(x, weight, bias)
        x = x * (x.square().mean(-1, keepdim=True) + e).rsqrt() * (scale if scale.ndim == 1 else scale.unsqueeze(1))
        x = x * (1 + x * (x.square() + 4).rsqrt()) / 2
    return _linear(x, params[-2], params[-1])


def plain_normal(
    x: Tensor, params: Sequence[Tensor], *, head: NormalHead, eps: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Mean and scale by :func:`plain_layers` and a head."""
    return head(plain_layers(x, params, eps))


class _Layers(torch.autograd.Function):
    """:func:`plain_layers`, whose intermediate results nobody else sees, so that most are computed in place.

    With ``h = y / 2`` of the normalised ``y``, Squish is ``h + h s`` with ``s = h / sqrt(h^2 + 1)``: halves are exact.
    """

    @staticmethod
    def forward(ctx: Any, eps: tuple[float, ...], x: Tensor, *params: Tensor) -> Tensor:
        kept: list[Tensor] = []
        grad, y = any(ctx.needs_input_grad), x
        buffer: Tensor | None = None
        for index, e in enumerate(eps):
            weight, bias, scale = params[3 * index : 3 * index + 3]
            unit = _linear(y, weight, bias)
            inverse = torch.linalg.vector_norm(unit, dim=-1, keepdim=True)
            inverse = inverse.square_().div_(unit.shape[-1]).add_(e).rsqrt_()
            unit.mul_(inverse)
            half = 0.5 * (scale if scale.ndim == 1 else scale.unsqueeze(1))
            h = unit * half if grad else unit.mul_(half)
            if buffer is None or grad or buffer.shape != h.shape:
                buffer = torch.empty_like(h)
            s = torch.addcmul(h.new_ones(()), h, h, out=buffer).rsqrt_().mul_(h)
            y = h.addcmul_(h, s)
            kept += [unit, inverse, s, y] if grad else []
        if grad:
            ctx.save_for_backward(x, *params, *kept)
            ctx.eps = eps
        return _linear(y, params[-2], params[-1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        count = 3 * len(ctx.eps) + 2
        x, params, kept = ctx.saved_tensors[0], ctx.saved_tensors[1 : count + 1], ctx.saved_tensors[count + 1 :]
        needed = ctx.needs_input_grad[1:]
        if torch.is_grad_enabled():  # a gradient of it is wanted: of the plain formula, which autograd knows
            return (None, *_plain_gradients((x, *params), needed, grad, ctx.eps))
        grads: list[Tensor | None] = [None] * (count + 1)
        rows = grad.ndim - 2  # the dimension of the samples
        g = grad
        for index in range(len(ctx.eps), -1, -1):
            below = kept[4 * index - 1] if index else x
            if needed[3 * index + 1]:
                # As autograd multiplies: the transposed product may round otherwise.
                grads[3 * index + 1] = (below.mT @ g).mT if rows else g.mT @ below
            if needed[3 * index + 2]:
                grads[3 * index + 2] = g.sum(rows)
            if not index:
                grads[0] = g @ params[0] if needed[0] else None
                break
            g = g @ params[3 * index]
            unit, inverse, s = kept[4 * index - 4 : 4 * index - 1]
            scale = params[3 * index - 1].unsqueeze(rows)
            by_y = s.square()
            torch.addcmul(s, s, by_y, value=-0.5, out=by_y).add_(0.5).mul_(g)  # (1 + 2 s - s^3) / 2
            product = torch.mul(by_y, unit, out=g)
            if needed[3 * index]:
                grads[3 * index] = product.sum(rows)
            common = product.mul_(scale).mean(-1, keepdim=True)
            g = by_y.mul_(scale).addcmul_(unit, common, value=-1).mul_(inverse)
        return (None, *grads)


def _plain_gradients(
    inputs: Sequence[Tensor], needed: Sequence[bool], grad: Tensor, eps: tuple[float, ...]
) -> list[Tensor | None]:
    """Gradients of the plain formula with respect to its inputs, which have gradients of their own."""
    wanted = [x for x, need in zip(inputs, needed, strict=True) if need]
    out = plain_layers(inputs[0], inputs[1:], eps)
    found = iter(torch.autograd.grad(out, wanted, grad, create_graph=True))
    return [next(found) if need else None for need in needed]


class FastNetwork(NamedTuple):
    """A network of :func:`~torchrl_tsallis.modules.make_policy` as a function of its parameters.

    Attributes:
        layers: the modules in their order, the head last.
        kinds: their classes, which a parametrization changes.
        keys: of the parameters in the tensordict of the actor's, in the order of :func:`plain_layers`.
        shapes: of the parameters.
        sizes: of the input, the hidden layers and the last layer's output.
        eps: epsilon of each RMSNorm; None for the data type's own.
    """

    layers: tuple[nn.Module, ...]
    kinds: tuple[type, ...]
    keys: tuple[tuple[str, ...], ...]
    shapes: tuple[torch.Size, ...]
    sizes: tuple[int, ...]
    eps: tuple[float | None, ...]

    @property
    def head(self) -> NormalHead:
        """Makes mean and scale of the last layer's output."""
        return self.layers[-1]  # type: ignore[return-value]

    def __call__(self, x: Tensor, params: TensorDictBase) -> tuple[Tensor, Tensor] | None:
        """Mean and scale ``[*B, A]`` of inputs ``[*B, in]``; of members ``[S, *B, A]``.

        Args:
            x: the observations.
            params: of the actor, with ``keys``; of members ``[S]``.

        Returns:
            Mean and scale; None for what only the modules can take, or say what is wrong with it.
        """
        tensors = [params.get(key) for key in self.keys]
        first, members = tensors[0], tensors[0].ndim - 2
        if not (
            isinstance(x, Tensor)
            and x.dtype == first.dtype
            and x.dtype in (torch.float32, torch.float64)
            and x.device == first.device
            and x.ndim > 1 + members
            and x.shape[-1] == self.sizes[0]
            and x.shape[:members] == first.shape[:members]
            and x.numel()
            and all(p.shape == first.shape[:members] + shape for p, shape in zip(tensors, self.shapes, strict=True))
            and not torch.is_autocast_enabled(x.device.type)
        ):
            return None
        own = torch.finfo(x.dtype).eps
        eps = tuple(own if e is None else e for e in self.eps)
        rows = x.reshape(*first.shape[:members], -1, x.shape[-1])
        kernels = native.active()
        if kernels is not None and not x.requires_grad and fits(x, *tensors):
            plain = partial(plain_normal, head=self.head, eps=eps)
            loc, scale = native_network(kernels, plain, self.sizes, eps, self.head.min_scale, rows, tensors)
            return loc.view(*x.shape[:-1], -1), scale.view(*x.shape[:-1], -1)
        out = _Layers.apply(eps, rows, *tensors)
        return self.head(out.view(*x.shape[:-1], out.shape[-1]))


_known: WeakKeyDictionary[nn.Module, FastNetwork | None] = WeakKeyDictionary()


def network_of(actor: nn.Module, network: nn.Module) -> FastNetwork | None:
    """The network of an actor as a function of its parameters, if it is the paper's and nothing else is looking.

    Args:
        actor: whose parameters' tensordict it will be given.
        network: the part of it that maps an observation to mean and scale.

    Returns:
        The function; None for any other network, one with hooks, and while a compiler, tracer or function transform
        is at work.

    Examples:
        >>> from torchrl_tsallis.modules import make_policy
        >>> actor = make_policy(3, 2)
        >>> network_of(actor, actor.module[0].module).sizes
        (3, 100, 100, 4)
    """
    if type(network) is not nn.Sequential or is_watched():
        return None
    layers = tuple(network._modules.values())
    known = _known.get(network)
    if known is None or known.layers != layers or known.kinds != tuple(map(type, layers)):
        known = _known[network] = _recognised(actor, network, layers)
    if known is None or any(_is_changed(module) for module in (network, *layers)):
        return None
    return known


def _is_changed(module: nn.Module | None) -> bool:
    """Whether a call of the module is more than its class's ``forward``."""
    attributes = module.__dict__
    return any(attributes[name] for name in _HOOKS) or "forward" in attributes


def _recognised(actor: nn.Module, network: nn.Module, layers: tuple[Any, ...]) -> FastNetwork | None:
    """The network's layers, where they are those of the paper."""
    hidden, rest = divmod(len(layers) - 2, 3)
    kinds = [Linear, RMSNorm, Squish] * hidden + [Linear, NormalHead]
    alike = hidden > 0 and not rest and [type(module) for module in layers] == kinds
    if not alike or len(set(map(id, layers))) != len(layers):  # a layer that is used twice has its parameters once
        return None
    linears, norms = layers[:-1:3], layers[1:-2:3]
    sizes = (linears[0].in_features, *(layer.out_features for layer in linears))
    fits = sizes[-1] % 2 == 0 and all(layer.in_features == size for layer, size in zip(linears, sizes, strict=False))
    fits &= all(norm.normalized_shape == (size,) for norm, size in zip(norms, sizes[1:], strict=False))
    prefix = next((name for name, module in actor.named_modules() if module is network), None)
    if not fits or prefix is None or any(layer.bias is None for layer in linears):
        return None
    start = tuple(prefix.split(".")) if prefix else ()
    keys = [(*start, str(name), part) for name, kind in enumerate(kinds) for part in _NAMES.get(kind, ())]
    shapes = tuple(getattr(layers[int(key[-2])], key[-1]).shape for key in keys)
    return FastNetwork(layers, tuple(kinds), tuple(keys), shapes, sizes, tuple(norm.eps for norm in norms))
