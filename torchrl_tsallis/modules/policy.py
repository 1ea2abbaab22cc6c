"""The paper's policy network, as a factory of a TorchRL actor."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis.modules.activations import Squish, squareplus
from torchrl_tsallis.modules.linear import Linear
from torchrl_tsallis.modules.norm import RMSNorm


class NormalHead(nn.Module):
    """Splits the network's output into mean and positive scale of a diagonal normal.

    Args:
        min_scale: added to the squareplus of the raw scale; 0 as in the paper.

    Examples:
        >>> import torch
        >>> loc, scale = NormalHead()(torch.zeros(5, 4))
        >>> loc.shape, scale[0]
        (torch.Size([5, 2]), tensor([1., 1.]))
    """

    stackable = True

    def __init__(self, min_scale: float = 0.0) -> None:
        super().__init__()
        self.min_scale = min_scale

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``[*B, 2A]`` to mean ``[*B, A]`` and scale ``[*B, A]``."""
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
        ValueError: if a dimension is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> make_policy(28, 8)(TensorDict({"observation": torch.zeros(3, 28)}, [3]))["action"].shape
        torch.Size([3, 8])
    """
    sizes = [obs_dim, *hidden]
    if min(*sizes, action_dim) < 1:
        raise ValueError(f"every dimension must be positive, got {obs_dim=}, {action_dim=}, {hidden=}")
    layers: list[nn.Module] = []
    for n_in, n_out in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [Linear(n_in, n_out), RMSNorm(n_out), Squish()]
    network = nn.Sequential(*layers, Linear(sizes[-1], 2 * action_dim), NormalHead())
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[observation_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=IndependentNormal,
    )
