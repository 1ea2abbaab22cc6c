"""The paper's policy network, as a factory of a TorchRL actor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.modules.activations import Squish, squareplus
from torchrl_tsallis.modules.linear import Linear
from torchrl_tsallis.modules.norm import RMSNorm
from torchrl_tsallis.modules.numerics import is_traced, widened
from torchrl_tsallis.modules.settings import check_dims, check_key, memory_for


class NormalHead(nn.Module):
    """Splits the network's output into mean and positive scale of a diagonal normal.

    Under autocast both are float32: a density in the three digits of bfloat16 would be off by percents.

    Args:
        min_scale: added to the squareplus of the raw scale; 0 as in the paper.

    Raises:
        TypeError: for a ``min_scale`` that is no number.
        ValueError: for one that is negative or not finite, and for an output of odd length.

    Examples:
        >>> import torch
        >>> loc, scale = NormalHead()(torch.zeros(5, 4))
        >>> loc.shape, scale[0]
        (torch.Size([5, 2]), tensor([1., 1.]))
    """

    stackable = True

    def __init__(self, min_scale: float = 0.0) -> None:
        super().__init__()
        self.min_scale = check_number("min_scale", min_scale, low=0)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``[*B, 2A]`` to mean ``[*B, A]`` and scale ``[*B, A]``."""
        if not is_traced() and x.shape[-1] % 2:
            raise ValueError(
                f"the network's output has shape {list(x.shape)}: its last dimension must be 2 x the action's, for "
                "mean and scale"
            )
        if torch.is_autocast_enabled(x.device.type):
            x = widened(x)
        loc, raw = x.chunk(2, -1)
        return loc, squareplus(raw) + self.min_scale


def make_policy(
    obs_dim: int,
    action_dim: int,
    *,
    hidden: Sequence[int] = (100, 100),
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> ProbabilisticActor:
    """Builds the imitator of section V-B: hidden layers with RMSNorm and Squish, and a diagonal normal.

    Its network, ``actor.module[0].module``, maps the observation to mean and scale, and is what ``torch.export``, the
    ONNX exporters and ``torch.jit.trace`` take for a robot without Python.

    Args:
        obs_dim: dimension of the observation.
        action_dim: dimension A of the raw action. The policy's density is over the raw, unsquashed action; clip the
            mean to the action space when it is executed.
        hidden: widths of the hidden layers (2 x 100, section V-B).
        observation_key: key of the observation, ``[*B, obs_dim]``.
        action_key: key of the action, ``[*B, A]``.

    Returns:
        An actor that writes ``loc``, ``scale`` and the action.

    Raises:
        TypeError: for a dimension that is no integer, hidden widths that are no sequence, or a key that is none.
        ValueError: if a dimension is not positive, or a key is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> make_policy(28, 8)(TensorDict({"observation": torch.zeros(3, 28)}, [3]))["action"].shape
        torch.Size([3, 8])
    """
    if isinstance(hidden, (str, bytes)) or not isinstance(hidden, Sequence):
        raise TypeError(f"hidden must be a sequence of widths, one a hidden layer, got {shown(hidden)}")
    check_dims(obs_dim=obs_dim, **{f"hidden[{i}]": n for i, n in enumerate(hidden)}, action_dim=action_dim)
    sizes = [int(n) for n in (obs_dim, *hidden)]
    check_key("observation_key", observation_key)
    check_key("action_key", action_key)
    layers: list[nn.Module] = []
    with memory_for(obs_dim=obs_dim, hidden=hidden, action_dim=action_dim):
        for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
            layers += [Linear(n_in, n_out), RMSNorm(n_out), Squish()]
        network = nn.Sequential(*layers, Linear(sizes[-1], 2 * int(action_dim)), NormalHead())
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[observation_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=IndependentNormal,
    )
