"""From what a TorchRL loss reads and returns to one number a sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_right, unravel_key
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_tsallis.ratings.base import Evidence

#: Numbers from here on are taken for infinitely far: their squares leave the range of float32.
FAR = 1e18


def plain_inputs(tensordict: TensorDictBase, loss: LossModule, networks: Sequence[nn.Module]) -> TensorDictBase:
    """A batch, checked, whose batch size is that of its samples; the caller's tensordict is never written to.

    Args:
        tensordict: the batch, ``[*B]``; without a batch size, the first dimension is that of the samples.
        loss: what reads it.
        networks: of the loss.

    Returns:
        A copy without the tensors' data.

    Raises:
        KeyError: if a key is missing.
        TypeError: if an input is of another floating-point type than the parameters.
        ValueError: if the batch is empty, or its samples cannot be told apart.
    """
    if getattr(loss.tensor_keys, "pad_mask", None) is not None:
        raise ValueError(
            f"{type(loss).__name__} with pad_mask={loss.tensor_keys.pad_mask!r} returns its elements without their "
            "samples: leave padded samples out by loss_mask_key instead, and set_keys(pad_mask=None)"
        )
    keys = tensordict.keys(True)
    # A recurrent actor's state, which is zero where it is not given.
    actors = [x for x in networks if isinstance(x, TensorDictModuleBase)]
    carried = {key for x in actors for key in x.in_keys if unravel_key(("next", key)) in x.out_keys}
    missing = [key for key in loss.in_keys if unravel_key(key) not in keys and key not in carried]
    if missing:
        raise KeyError(
            f"the batch has no {missing[0]!r}; it holds {sorted(map(str, tensordict.keys(True, True)))}. "
            "Name the keys by loss.set_keys(...)"
        )
    inputs = tensordict.copy()
    if not inputs.ndim:
        inputs.auto_batch_size_(1)
    if not inputs.ndim or 0 in inputs.shape:
        raise ValueError(
            f"the batch of shape {list(inputs.shape)} has no samples: give the tensordict the batch size of its samples"
        )
    wanted = next((p.dtype for p in loss.parameters() if p.is_floating_point()), None)
    for key in loss.in_keys:
        found = inputs.get(key, None)
        if isinstance(found, Tensor) and found.is_floating_point() and wanted not in (None, found.dtype):
            raise TypeError(
                f"{key!r} is {found.dtype}, the loss's parameters are {wanted}: convert the data to their type, for "
                "instance by tensordict.float()"
            )
    return inputs


def split_far(
    inputs: TensorDictBase, in_keys: Sequence[NestedKey], mask: Tensor | None
) -> tuple[TensorDictBase, Tensor]:
    """Takes out of a batch what must not reach a network: padding, and numbers whose squares overflow.

    Either would make the weights' gradients NaN, even with a weight of 0.

    Args:
        inputs: ``[*B]``.
        in_keys: keys of what the network sees.
        mask: valid samples, ``[*B]`` bool. Default: None, all.

    Returns:
        The batch with zeros for such samples, and which of the valid samples are infinitely far, ``[*B]`` bool. NaN
        is left where it is: it is no sample, and has to be noticed.

    Examples:
        >>> from tensordict import TensorDict
        >>> _, far = split_far(TensorDict({"action": torch.tensor([[1.0, 2.0], [1e30, 0.0]])}, [2]), ["action"], None)
        >>> far
        tensor([False, True])
    """
    found = {key: inputs.get(key, None) for key in in_keys}
    tensors = {key: x for key, x in found.items() if isinstance(x, Tensor)}
    far = torch.zeros(inputs.shape, dtype=torch.bool, device=next(iter(tensors.values())).device)
    for x in tensors.values():
        if x.is_floating_point():
            far = far | (x.abs() >= FAR).reshape(*inputs.shape, -1).any(-1)
    keep = ~far if mask is None else mask & ~far
    for key, x in tensors.items():
        inputs.set(key, x.where(expand_right(keep, x.shape), torch.zeros_like(x)))
    return inputs, far if mask is None else far & mask


def losses_of_samples(
    output: TensorDictBase, key: NestedKey, shape: torch.Size, mask: Tensor | None
) -> tuple[Tensor, int]:
    """The loss of each sample, averaged over what dimensions it has beside those of the batch.

    Args:
        output: of the loss.
        key: of the loss.
        shape: ``[*B]``.
        mask: valid samples, ``[*B]`` bool. Default: None, all.

    Returns:
        The losses, ``[*B]``, with gradient, and how many elements each is a mean over.

    Raises:
        KeyError: if the loss returns no such key.
        ValueError: if the output has another shape, or valid samples' losses are negative.

    Examples:
        >>> from tensordict import TensorDict
        >>> out = TensorDict({"loss": torch.tensor([[1.0, 3.0], [5.0, 7.0]])})
        >>> losses_of_samples(out, "loss", torch.Size([2]), None)
        (tensor([2., 6.]), 2)
    """
    losses: Any = output.get(key, None)
    if losses is None:
        raise KeyError(f"the loss returns {sorted(map(str, output.keys(True, True)))}, no {key!r}: see loss_key")
    elements = losses.shape[len(shape) :].numel()
    if losses.shape[: len(shape)] != shape:
        raise ValueError(
            f"{key!r} has shape {list(losses.shape)}, the batch {list(shape)}: the loss has to be one with "
            "reduction='none' that keeps the samples apart"
        )
    if losses.ndim > len(shape):
        losses = losses.flatten(len(shape)).mean(-1)
    if not torch.compiler.is_compiling() and not torch._C._functorch.is_batchedtensor(losses):
        below = losses.detach() < 0
        if bool((below if mask is None else below & mask).any()):
            raise ValueError(
                f"{key!r} has negative values, down to {losses.min().item():g}: a loss is rated relative to its size, "
                "which needs one that is 0 at best. Rate a log-density by TsallisBCLoss(actor, rating=PeakRating())"
            )
    return losses, elements


def action_dims(loss: LossModule, inputs: TensorDictBase) -> int:
    """Number of elements that the action (chunk) has a sample.

    Args:
        loss: which knows the key of it.
        inputs: ``[*B]``.

    Raises:
        ValueError: if there is no such key.
    """
    for name in ("action_chunk", "action"):
        action = inputs.get(getattr(loss.tensor_keys, name, None) or name, None)
        if isinstance(action, Tensor):
            return action.shape[inputs.ndim :].numel()
    raise ValueError(f"{type(loss).__name__} names no action: say by dims= how many dimensions its loss is a mean over")


def means_of_others(
    evidence: Evidence, loss_key: str, name_of: Callable[[NestedKey], NestedKey]
) -> dict[NestedKey, Tensor]:
    """Means over a batch of what a loss returns beside the loss of each sample.

    Args:
        evidence: whose ``written`` is what the loss has returned.
        loss_key: of the loss of each sample.
        name_of: gives the name of a mean from the key.

    Returns:
        The means, detached scalars.

    Raises:
        ValueError: if another output is a loss with gradient, which nobody would minimise.
    """
    out, shape = {}, evidence.likelihood.shape
    for key, value in evidence.written.items(True, True):
        if key == loss_key:
            continue
        if isinstance(key, str) and key.startswith("loss") and value.requires_grad:
            raise ValueError(
                f"the loss is {loss_key!r}, but {key!r} has a gradient too: RatedLoss minimises one output, "
                "which has to be the sum of all terms"
            )
        value = value.detach().to(evidence.likelihood.dtype)
        if value.shape[: len(shape)] == shape:
            rest = value.flatten(len(shape)).mean(-1) if value.ndim > len(shape) else value
            (out[name_of(key)],) = evidence.batch.mean(rest)
        else:
            out[name_of(key)] = value.mean()
    return out
