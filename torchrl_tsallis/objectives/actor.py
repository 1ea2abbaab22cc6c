"""The distribution of an actor, or of stacked ones, at the cost of the network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_tsallis.modules.fast import network_of


def _network_and_head(
    actor: ProbabilisticTensorDictSequential,
) -> tuple[TensorDictModule, ProbabilisticTensorDictModule] | None:
    """The two parts of an actor that has no others, and no options or hooks that change a call; else None."""
    modules = list(actor._module_iter())
    if len(modules) != 2 or actor.return_composite:
        return None
    network, head = modules
    plain = (
        type(network) is TensorDictModule
        and isinstance(head, ProbabilisticTensorDictModule)
        and network.method is None
        and network._kwargs is None
        and not (network.method_kwargs or network._get_kwargs or network._forward_hooks or network._forward_pre_hooks)
        and all(key in network.out_keys for key in head.in_keys)
    )
    return (network, head) if plain else None


def _call(network: TensorDictModule, tensors: Sequence[Any]) -> dict[NestedKey, Any]:
    """The network's outputs by key, as its ``TensorDictModule`` would write them."""
    out: Any = network.module(*tensors)
    keys = network.out_keys
    if isinstance(out, (Mapping, TensorDictBase)) and all(key in out for key in keys):
        out = [out[key] for key in keys]
    elif not isinstance(out, (tuple, list)):
        out = [out]
    return dict(zip(keys, out, strict=True))


def _fast_outputs(
    actor: ProbabilisticTensorDictSequential,
    parts: tuple[TensorDictModule, ProbabilisticTensorDictModule] | None,
    inputs: TensorDictBase,
    params: TensorDictBase,
) -> dict[NestedKey, Any] | None:
    """The network's outputs by key, where it is the paper's; its parameters need not be written into it."""
    if parts is None or len(parts[0].in_keys) != 1 or len(parts[0].out_keys) != 2:
        return None
    network = network_of(actor, parts[0].module)
    out = None if network is None else network(inputs.get(parts[0].in_keys[0]), params)
    return None if out is None else dict(zip(parts[0].out_keys, out, strict=True))


def get_dist_with(
    actor: ProbabilisticTensorDictSequential, inputs: TensorDictBase, params: TensorDictBase
) -> Distribution:
    """:func:`get_dist` of an actor with other parameters.

    Args:
        actor: stochastic actor.
        inputs: with the actor's input keys, ``[*B]``.
        params: parameters of the actor, such as those of its target network.

    Returns:
        The distribution of the action, batch shape ``[*B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis.modules import make_policy
        >>> actor, data = make_policy(3, 2), TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> get_dist_with(actor, data, TensorDict.from_module(actor) * 0).mean[0].detach()
        tensor([0., 0.])
    """
    parts = _network_and_head(actor)
    fast = _fast_outputs(actor, parts, inputs, params)
    if parts is not None and fast is not None:
        return parts[1].get_dist(fast)
    with params.to_module(actor, preserve_module_state=False):
        return get_dist(actor, inputs)


def get_dist(actor: ProbabilisticTensorDictSequential, inputs: TensorDictBase) -> Distribution:
    """``actor.get_dist(inputs)`` that never writes to its inputs.

    Where the actor is a network and a head, as ``ProbabilisticActor`` makes it, their tensors are handed over directly.
    The tensordicts in between would cost as much as a small network on a CPU.

    Args:
        actor: stochastic actor.
        inputs: with the actor's input keys, ``[*B]``.

    Returns:
        The distribution of the action, batch shape ``[*B]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis.modules import make_policy
        >>> get_dist(make_policy(3, 2), TensorDict({"observation": torch.zeros(5, 3)}, [5])).batch_shape
        torch.Size([5])
    """
    parts = _network_and_head(actor)
    with named_inputs(actor, inputs):
        if parts is None:
            return actor.get_dist(inputs.copy())
        network, head = parts
        return head.get_dist(_call(network, [inputs.get(key) for key in network.in_keys]))


@contextmanager
def named_inputs(actor: Any, inputs: TensorDictBase) -> Iterator[None]:
    """Says what a network was given that it could not take: torch only speaks of matrices.

    Args:
        actor: the network, with ``in_keys``.
        inputs: what it is given.

    Raises:
        TypeError: if an input is of another type than the actor's parameters.
        ValueError: for anything else, which is mostly a wrong size.
    """
    try:
        yield
    except (RuntimeError, IndexError, TypeError, AttributeError, ValueError) as error:
        if torch.compiler.is_compiling():
            raise
        wanted = {p.dtype for p in actor.parameters() if p.is_floating_point()}
        given = {key: inputs.get(key) for key in actor.in_keys if inputs.get(key, None) is not None}
        odd = any(not isinstance(x, Tensor) or x.dtype not in wanted for x in given.values()) or not inputs.ndim
        if isinstance(error, NotImplementedError) or not (odd or isinstance(error, (RuntimeError, IndexError))):
            raise  # a fault of the network's own
        listed = ", ".join(
            f"{key!r} {list(x.shape)} {x.dtype if isinstance(x, Tensor) else type(x).__name__}"
            for key, x in given.items()
        )
        text = f"the actor cannot take {listed}"
        if wanted and any(isinstance(x, Tensor) and x.dtype not in wanted | {torch.bool} for x in given.values()):
            names = ", ".join(map(str, wanted))
            raise TypeError(
                f"{text}: its parameters are {names}; convert the data, or the actor, to one type"
            ) from error
        raise ValueError(
            f"{text}: check the size that its network was made for ({str(error).splitlines()[0]})"
        ) from error


def _is_stackable(module: nn.Module) -> bool:
    """Whether each module takes parameters with a leading member dimension."""
    return all(isinstance(m, nn.Sequential) or getattr(m, "stackable", False) for m in module.modules())


def get_stacked_dist(
    actor: ProbabilisticTensorDictSequential,
    inputs: TensorDictBase,
    params: TensorDictBase,
    randomness: str = "error",
) -> Distribution:
    """Distribution of S members at once, each with parameters and a batch of its own.

    Only the networks are vectorized, by ``torch.vmap``, or by themselves where all of their modules take stacked
    parameters (see :class:`~torchrl_tsallis.modules.Linear`). The distribution is made of the stacked results, because
    its checks of values cannot run under vmap.

    Args:
        actor: stochastic actor whose structure all members have.
        inputs: with the actor's input keys, ``[S, *B]``.
        params: the members' parameters, ``[S]``.
        randomness: of ``torch.vmap``.

    Returns:
        The distribution of the action, batch shape ``[S, *B]``.

    Raises:
        NotImplementedError: for an actor of several distributions (``return_composite``).
    """
    parts = _network_and_head(actor)
    if actor.return_composite:
        raise NotImplementedError("stacked members need an actor with one distribution (return_composite=False)")

    fast = _fast_outputs(actor, parts, inputs, params)
    if parts is not None and fast is not None:
        return parts[1].get_dist(fast)
    if parts is not None and _is_stackable(parts[0].module):
        with params.to_module(actor, preserve_module_state=False), named_inputs(actor, inputs):
            return parts[1].get_dist(_call(parts[0], [inputs.get(key) for key in parts[0].in_keys]))

    def call(params: TensorDictBase, *given: Any) -> Any:
        with params.to_module(actor, preserve_module_state=False):
            return actor.get_dist_params(*given) if parts is None else _call(parts[0], given)

    vectorized = torch.vmap(call, randomness=randomness)
    with named_inputs(actor, inputs):
        if parts is None:
            return actor.build_dist_from_params(vectorized(params, inputs.copy()))
        return parts[1].get_dist(vectorized(params, *(inputs.get(key) for key in parts[0].in_keys)))


def own_parameters(params: TensorDictParams) -> TensorDictParams:
    """Parameters as copies that an optimizer takes, where there is a gradient to take."""

    def own(x: Tensor) -> Tensor:
        return nn.Parameter(x.detach().clone()) if x.requires_grad else x.clone()

    return TensorDictParams(params.apply(own), no_convert=True)
