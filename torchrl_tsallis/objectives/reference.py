"""Reference densities: what the imitator's density is compared with to rate a sample.

The paper compares with a mixture of 1 and the target network (eq. 10). The choice is one exchangeable object, so that
another reference needs no other loss.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from torchrl_tsallis.functional import adaptive_gamma, log_mixture


class Reference(NamedTuple):
    """A reference density at a batch's actions.

    Attributes:
        log_density: its logarithm, ``[*B]`` or a scalar.
        gamma_mix: the relative rating level in force, a scalar.
    """

    log_density: Tensor
    gamma_mix: Tensor


class ReferenceDensity(nn.Module):
    """Base class of the reference densities; subclass it and pass an instance to ``TsallisBCLoss``."""

    #: Whether the target network's log-density is needed.
    needs_target: bool = False
    #: Whether :math:`E[\pi^{1-q}]` decides about the reference, as it does for an adaptive gamma.
    adaptive: bool = False

    def forward(
        self, dist: torch.distributions.Distribution, target_log_prob: Tensor | None, moment: Tensor
    ) -> Reference:
        r"""Computes the reference density; called without gradient.

        Args:
            dist: the imitator's distribution, batch shape ``[*B]``.
            target_log_prob: the target network's log-density at the actions, ``[*B]``; None unless ``needs_target``.
            moment: batch estimate of :math:`E[\pi^{1-q}]`, a scalar.

        Returns:
            The reference at the batch's actions.
        """
        raise NotImplementedError


class MixtureReference(ReferenceDensity):
    r"""The paper's mixture of absolute and relative rating (eq. 10), with a fixed or adaptive gamma (eq. 13).

    .. math:: \pi_\gamma = (1-\gamma) + \gamma \bar\pi

    =========  ===========  ==========  ============
    symbol     argument     default     source
    =========  ===========  ==========  ============
    gamma      gamma_mix    "adaptive"  eq. 13
    min gamma  gamma_min    0.1         section V-B
    max gamma  gamma_max    0.9         section V-B
    =========  ===========  ==========  ============

    Args:
        gamma_mix: ``"adaptive"`` or a number in [0, 1]; 0 is q-BC (absolute rating), 1 the pure relative rating.
        gamma_min: lower bound of the adaptive gamma.
        gamma_max: upper bound of the adaptive gamma.

    Raises:
        ValueError: if a level is outside of its range.

    Examples:
        >>> MixtureReference(0.0).needs_target
        False
    """

    def __init__(
        self, gamma_mix: float | Literal["adaptive"] = "adaptive", gamma_min: float = 0.1, gamma_max: float = 0.9
    ) -> None:
        super().__init__()
        if not 0 < gamma_min <= gamma_max < 1:
            raise ValueError(f"0 < gamma_min <= gamma_max < 1 is needed, got {gamma_min=} and {gamma_max=}")
        if isinstance(gamma_mix, str):
            if gamma_mix != "adaptive":
                raise ValueError(f"gamma_mix must be 'adaptive' or a number in [0, 1], got {gamma_mix!r}")
        elif not 0 <= gamma_mix <= 1:
            raise ValueError(f"gamma_mix must be 'adaptive' or a number in [0, 1], got {gamma_mix!r}")
        self.gamma_mix = gamma_mix
        self.gamma_min = gamma_min
        self.gamma_max = gamma_max
        self.adaptive = gamma_mix == "adaptive"
        self.needs_target = gamma_mix != 0

    @property
    def fixed_gamma(self) -> float | None:
        """The fixed level, None where it is adaptive."""
        return None if isinstance(self.gamma_mix, str) else float(self.gamma_mix)

    def forward(
        self, dist: torch.distributions.Distribution, target_log_prob: Tensor | None, moment: Tensor
    ) -> Reference:
        """See :meth:`ReferenceDensity.forward`."""
        if self.fixed_gamma is None:
            gamma = adaptive_gamma(moment, self.gamma_min, self.gamma_max)
        else:
            gamma = torch.full_like(moment, self.fixed_gamma)
        if target_log_prob is None:
            return Reference(torch.zeros_like(gamma), gamma)
        return Reference(log_mixture(target_log_prob, gamma), gamma)
