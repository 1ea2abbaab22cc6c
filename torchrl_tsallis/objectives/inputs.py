"""What a loss passes on of a batch, and the checks of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_right, unravel_key
from torch import Tensor


def select_inputs(
    tensordict: TensorDictBase,
    actor: TensorDictModuleBase,
    in_keys: Sequence[NestedKey],
    *,
    members: int | None = None,
    mask: Tensor | None = None,
) -> TensorDictBase:
    """Selects the action and the actor's inputs, checked; the caller's tensordict is never written to.

    Args:
        tensordict: the batch, ``[*B]``, or ``[S, *B]`` with stacked members.
        actor: the actor network.
        in_keys: the action's key first, then the actor's inputs.
        members: S, the number of stacked members, if there are any.
        mask: valid samples, ``[*B]``; what the others hold is replaced by zeros.

    Returns:
        A tensordict with ``in_keys``; a recurrent actor's state is there only if the batch holds it.

    Raises:
        ValueError: if the batch is empty, or its first dimension is not that of the members.
        KeyError: if a key is missing.
        TypeError: if action and observation are of different floating-point types.
    """
    if members is not None and tensordict.shape[:1] != (members,):
        raise ValueError(
            f"the batch of shape {list(tensordict.shape)} must have the {members} members first: "
            "sample it from make_stacked_replay_buffer, or use tensordict.expand(members, ...)"
        )
    if 0 in tensordict.shape:
        raise ValueError(f"the batch of shape {list(tensordict.shape)} is empty: pass at least one sample")
    keys = tensordict.keys(True)
    carried = {key for key in actor.in_keys if unravel_key(("next", key)) in actor.out_keys}
    missing = [key for key in in_keys if key not in keys and key not in carried]
    if missing:
        raise KeyError(
            f"the batch has no {missing[0]!r}; it holds {sorted(map(str, tensordict.keys(True, True)))}. "
            f"Name the action's key by loss.set_keys(action=...) and the observations' by the actor's in_keys"
        )
    inputs = tensordict.select(*in_keys, strict=False)
    if mask is not None:
        # Padding may hold NaN, which would reach the weights' gradients through 0 * NaN in the network.
        inputs = inputs.apply(lambda x: x.where(expand_right(mask, x.shape), torch.zeros_like(x)))
    action, observation = (inputs.get(key) for key in in_keys[:2])
    if is_tensor_collection(action) or is_tensor_collection(observation):
        return inputs
    if action.is_floating_point() and observation.is_floating_point() and action.dtype != observation.dtype:
        raise TypeError(
            f"mixed dtypes: {in_keys[0]!r} is {action.dtype}, {in_keys[1]!r} is {observation.dtype}; "
            "convert the data to one of them, for instance by tensordict.float()"
        )
    return inputs
