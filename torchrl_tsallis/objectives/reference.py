"""Reference densities: what the imitator's density is compared with to rate a sample.

The paper compares with a mixture of 1 and the target network (eq. 10). The choice is one exchangeable object, so that
another reference needs no other loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrl_tsallis.functional import adaptive_gamma, log_mixture, per_sample


class Reference(NamedTuple):
    """A reference density at a batch's actions.

    Attributes:
        log_density: its logarithm, ``[*B]`` or a scalar; ``[S, *B]`` with members.
        gamma_mix: the relative rating level in force, a scalar; ``[S]`` with members.
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
            moment: batch estimate of :math:`E[\pi^{1-q}]`, a scalar. With stacked members every argument has their
                dimension first, ``[S]`` here.

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
        gamma_mix: ``"adaptive"`` or a number in [0, 1]; 0 is q-BC (absolute rating), 1 the pure relative rating. A
            sequence has one of them for each of S stacked members.
        gamma_min: lower bound of the adaptive gamma.
        gamma_max: upper bound of the adaptive gamma.

    Raises:
        ValueError: if a level is outside of its range.

    Examples:
        >>> MixtureReference(0.0).needs_target
        False
    """

    lower: Tensor
    upper: Tensor

    def __init__(
        self,
        gamma_mix: float | Literal["adaptive"] | Sequence[float | Literal["adaptive"]] = "adaptive",
        gamma_min: float = 0.1,
        gamma_max: float = 0.9,
    ) -> None:
        super().__init__()
        if not 0 < gamma_min <= gamma_max < 1:
            raise ValueError(f"0 < gamma_min <= gamma_max < 1 is needed, got {gamma_min=} and {gamma_max=}")
        many = isinstance(gamma_mix, Sequence) and not isinstance(gamma_mix, str)
        levels: list[Any] = list(cast("Sequence[Any]", gamma_mix)) if many else [gamma_mix]
        for level in levels:
            if level != "adaptive" and (isinstance(level, str) or not 0 <= level <= 1):
                raise ValueError(f"gamma_mix must be 'adaptive' or a number in [0, 1], got {level!r}")
        self.gamma_mix = gamma_mix
        self.levels = levels
        self.members = many
        self.gamma_min = gamma_min
        self.gamma_max = gamma_max
        self.adaptive = "adaptive" in levels
        self.needs_target = any(level != 0 for level in levels)
        if many:
            bounds = [(gamma_min, gamma_max) if level == "adaptive" else (level, level) for level in levels]
            for name, values in zip(("lower", "upper"), zip(*bounds, strict=True), strict=True):
                self.register_buffer(name, torch.tensor(values, dtype=torch.get_default_dtype()), persistent=False)

    @property
    def bounds(self) -> tuple[float, float] | tuple[Tensor, Tensor]:
        """Bounds of the adaptive level, floats or ``[S]``. A fixed level is an adaptive one between equal bounds."""
        if self.members:
            return self.lower, self.upper
        level = self.levels[0]
        return (self.gamma_min, self.gamma_max) if level == "adaptive" else (float(level), float(level))

    def forward(
        self, dist: torch.distributions.Distribution, target_log_prob: Tensor | None, moment: Tensor
    ) -> Reference:
        """See :meth:`ReferenceDensity.forward`."""
        lower, upper = self.bounds
        if isinstance(lower, Tensor):
            # A fixed level stays where the moment is NaN.
            gamma = lower.where(lower == upper, adaptive_gamma(moment, lower, upper))
        elif lower == upper:
            gamma = torch.full_like(moment, lower)
        else:
            gamma = adaptive_gamma(moment, lower, upper)
        if target_log_prob is None:
            return Reference(moment.new_zeros(()), gamma)
        return Reference(log_mixture(target_log_prob, per_sample(gamma, target_log_prob)), gamma)
