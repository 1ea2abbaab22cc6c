"""Log-densities of actions that stay finite, and have no gradient, where an action is out of reach."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import CompositeDistribution
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from torchrl_tsallis import native
from torchrl_tsallis.modules.numerics import is_watched
from torchrl_tsallis.native.network import fits, log_density

#: Standardised distances beyond this one are taken for infinite; their fourth power still fits in float32.
_FAR = 1e9


def log_prob_of(dist: Distribution, inputs: TensorDictBase, action_key: NestedKey) -> Tensor:
    """Log-density at the actions, after a check of the shapes, which broadcasting would hide.

    Args:
        dist: the actor's distribution, batch shape ``[*B]``.
        inputs: with the action, ``[*B]``.
        action_key: key of the action.

    Returns:
        The log-density, ``[*B]``.

    Raises:
        ValueError: if the shapes do not fit.
    """
    if isinstance(dist, CompositeDistribution):
        log_prob = dist.log_prob(inputs)
        return torch.stack(list(log_prob.values(True, True))).sum(0) if is_tensor_collection(log_prob) else log_prob
    action, expected = inputs.get(action_key), dist.batch_shape + dist.event_shape
    if dist.event_shape and action.shape != expected:
        raise ValueError(
            f"{action_key!r} has shape {list(action.shape)}, the actor's distribution {list(expected)}: the two must "
            "be equal (check the actor's action_dim and the batch size)"
        )
    try:
        log_prob = _safe_log_prob(dist, action)
    except (RuntimeError, TypeError) as error:
        if action.dtype.is_floating_point or torch.compiler.is_compiling():
            raise
        raise TypeError(
            f"{action_key!r} is {action.dtype}, of which the actor's {type(dist).__name__} has no density: convert the "
            "data to the type of the actor's parameters"
        ) from error
    shape, batch = log_prob.shape, inputs.batch_size
    # Without a batch size of its own the batch is what all inputs have in common, as for TorchRL's losses.
    fits = shape == batch if batch else all(x.shape[: len(shape)] == shape for x in inputs.values(True, True))
    if not fits:
        raise ValueError(
            f"log_prob has shape {list(shape)}, the batch {list(batch)}: give the batch its "
            "full batch size, and use a distribution that sums over the action's dimensions (IndependentNormal)"
        )
    return log_prob


def _safe_log_prob(dist: Distribution, action: Tensor) -> Tensor:
    """Log-density that is -inf, without gradient, for actions so far away that their gradient would overflow.

    The rating of such an action is 0, and 0 * inf would be NaN in the gradient of every parameter.
    """
    if not action.is_floating_point():
        return dist.log_prob(action)
    fast = _native_log_prob(dist, action)
    if fast is not None:
        return fast
    return _plain_log_prob(dist, action)


def _native_log_prob(dist: Distribution, action: Tensor) -> Tensor | None:
    """The same by the native kernels, where they are used and take it."""
    kernels = None if is_watched() else native.active()
    if kernels is None or not isinstance(dist, Independent) or dist.reinterpreted_batch_ndims != 1:
        return None
    normal = dist.base_dist
    if type(normal) is not Normal or normal._validate_args or dist._validate_args:
        return None
    loc, scale = normal.loc, normal.scale
    if not (fits(loc, scale, action) and loc.shape == scale.shape == action.shape) or action.requires_grad:
        return None
    return log_density(kernels, _normal_log_prob, loc, scale, action)


def _normal_log_prob(loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
    return _plain_log_prob(Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False), action)


def _plain_log_prob(dist: Distribution, action: Tensor) -> Tensor:
    with torch.no_grad():
        if type(dist.base_dist if isinstance(dist, Independent) else dist) is Normal:
            far = ((action - dist.mean) / dist.stddev).abs() > _FAR
            instead = dist.mean
        else:
            far, instead = action.isinf(), torch.zeros_like(action)
        action = torch.where(far, instead, action)
        far = far.any(-1) if dist.event_shape else far
    return dist.log_prob(action).masked_fill(far, -math.inf)
