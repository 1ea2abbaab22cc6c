"""What a loss is made of and is given, checked: the messages name the key, the shape and the way out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_right, unravel_key
from torch import Tensor, nn
from torchrl.objectives.common import LossModule


def check_actors(actor_network: Any) -> list[nn.Module] | None:
    """Stacked members as a list, or None for a single actor.

    Args:
        actor_network: what a loss was given.

    Returns:
        The members, if there are any.

    Raises:
        TypeError: if something is no stochastic actor.
        ValueError: for an empty list, or members of different shapes.

    Examples:
        >>> check_actors([])
        Traceback (most recent call last):
        ...
        ValueError: the list of actors is empty: pass an actor, or one for each stacked member
    """
    many = isinstance(actor_network, Sequence) and not isinstance(actor_network, str)
    actors = list(actor_network) if many else [actor_network]
    if not actors:
        raise ValueError("the list of actors is empty: pass an actor, or one for each stacked member")
    for actor in actors:
        if not isinstance(actor, TensorDictModuleBase) or not hasattr(actor, "get_dist"):
            raise TypeError(
                f"actor_network must be a stochastic actor, or a list of them, got {type(actor).__name__}: wrap a "
                "network in torchrl.modules.ProbabilisticActor, or use torchrl_tsallis.modules.make_policy"
            )
    shapes = [{name: x.shape for name, x in actor.state_dict().items() if isinstance(x, Tensor)} for actor in actors]
    for number, other in enumerate(shapes):
        if other != shapes[0]:
            name = next(n for n in {**shapes[0], **other} if shapes[0].get(n) != other.get(n))
            raise ValueError(
                f"stacked members must be alike but for their values: {name!r} is {_shape(shapes[0], name)} in actor 0 "
                f"and {_shape(other, name)} in actor {number}"
            )
    return actors if many else None


def _shape(shapes: dict[str, torch.Size], name: str) -> str:
    return str(list(shapes[name])) if name in shapes else "missing"


def check_key(name: str, key: Any) -> None:
    """Refuses what is no tensordict key.

    Args:
        name: of the setting.
        key: a string, a tuple of them, or None for the default.

    Raises:
        TypeError: for anything else, or an empty key.
    """
    parts = key if isinstance(key, tuple) else (key,)
    if key is not None and (not parts or not all(isinstance(part, str) and part for part in parts)):
        raise TypeError(f"{name} must be a key such as 'action' or ('robot', 'action'), got {key!r}")


def mask_of(loss: LossModule, tensordict: TensorDictBase) -> Tensor | None:
    """The valid samples of a batch by the loss's mask keys, ``[*B]`` bool; None where the batch carries no mask."""
    mask = None
    for key in loss._loss_mask_keys():
        found = tensordict.get(key, None)
        if found is not None:
            if tensordict.ndim:
                found = loss._expand_loss_mask(found, found.new_empty(tensordict.batch_size))
            mask = found if mask is None else mask & found
    return mask


def select_inputs(
    tensordict: TensorDictBase,
    actor: TensorDictModuleBase,
    in_keys: Sequence[NestedKey],
    *,
    members: int | None = None,
    mask: Tensor | None = None,
    dtype: torch.dtype | None = None,
) -> TensorDictBase:
    """Selects the action and the actor's inputs, checked; the caller's tensordict is never written to.

    Args:
        tensordict: the batch, ``[*B]``, or ``[S, *B]`` with stacked members.
        actor: the actor network.
        in_keys: the action's key first, then the actor's inputs.
        members: S, the number of stacked members, if there are any.
        mask: valid samples, ``[*B]``; what the others hold is replaced by zeros.
        dtype: of the actor's parameters. Default: None, the action may be of any.

    Returns:
        A tensordict with ``in_keys``; a recurrent actor's state is there only if the batch holds it.

    Raises:
        ValueError: if the batch is empty, or its first dimension is not that of the members.
        KeyError: if a key is missing.
        TypeError: if the action is of another floating-point type than the actor's parameters.
    """
    if members is not None and tensordict.shape[:1] != (members,):
        raise ValueError(
            f"the batch of shape {list(tensordict.shape)} must have the {members} members first: "
            "sample it from make_stacked_replay_buffer, or use tensordict.expand(members, ...)"
        )
    keys = tensordict.keys(True)
    carried = {key for key in actor.in_keys if unravel_key(("next", key)) in actor.out_keys}
    missing = [key for key in in_keys if key not in keys and key not in carried]
    if missing:
        raise KeyError(
            f"the batch has no {missing[0]!r}; it holds {sorted(map(str, tensordict.keys(True, True)))}. "
            f"Name the action's key by loss.set_keys(action=...) and the observations' by the actor's in_keys"
        )
    inputs = tensordict.select(*in_keys, strict=False)
    action = inputs.get(in_keys[0])
    if 0 in tensordict.shape or 0 in action.shape:
        raise ValueError(
            f"the batch of shape {list(tensordict.shape)}, actions {list(action.shape)}, is empty: "
            "pass at least one sample"
        )
    if mask is not None:
        # Padding may hold NaN, which would reach the weights' gradients through 0 * NaN in the network.
        inputs = inputs.apply(lambda x: x.where(expand_right(mask, x.shape), torch.zeros_like(x)))
    if not is_tensor_collection(action) and action.is_complex():
        raise TypeError(
            f"{in_keys[0]!r} is {action.dtype}, needed are real numbers: convert the data, for instance by .real"
        )
    if not is_tensor_collection(action) and action.is_floating_point() and action.dtype != (dtype or action.dtype):
        raise TypeError(
            f"{in_keys[0]!r} is {action.dtype}, the actor's parameters are {dtype}: "
            "convert the data to their type, for instance by tensordict.float()"
        )
    return inputs
