"""The distribution of an actor, at the cost of its network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch.distributions import Distribution


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
    if parts is None:
        return actor.get_dist(inputs.copy())
    network, head = parts
    out: Any = network.module(*(inputs.get(key) for key in network.in_keys))
    keys = network.out_keys
    if isinstance(out, (Mapping, TensorDictBase)) and all(key in out for key in keys):
        out = [out[key] for key in keys]
    elif not isinstance(out, (tuple, list)):
        out = [out]
    return head.get_dist(dict(zip(keys, out, strict=True)))
