"""The paper's rating: absolute-relative, against a mixture of 1 and the target network's density (eqs. 10-13)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchrl_tsallis._checks import shown
from torchrl_tsallis.ratings.base import Evidence, Rated, Rating
from torchrl_tsallis.ratings.numbers import as_numbers
from torchrl_tsallis.ratings.running import RunningMean
from torchrl_tsallis.ratings.tsallis.equations import adaptive_gamma, bound_ratio, log_mixture, rated_value, rating

Level = float | Literal["adaptive"]


class TsallisRating(Rating):
    r"""Adaptive absolute-relative rating from Tsallis statistics (eqs. 7, 9 and 11).

    .. math::
        \rho = (\pi / \pi_\gamma)^{1-q}, \qquad \pi_\gamma = (1-\gamma) + \gamma \bar\pi, \qquad
        \gamma = \mathrm{clip}(1 - \mathbb{E}[\pi^{1-q}], \underline\gamma, \overline\gamma)

    =========  ===========  ==========  ============
    symbol     argument     default     source
    =========  ===========  ==========  ============
    q          q            0.8         section V-B
    gamma      gamma_mix    "adaptive"  eq. 13
    min gamma  gamma_min    0.1         section V-B
    max gamma  gamma_max    0.9         section V-B
    beta       beta         0           eq. 1
    =========  ===========  ==========  ============

    The moment :math:`\mathbb{E}[\pi^{1-q}]` of an adaptive gamma is the batch's in training. A running mean of it is
    kept beside, and used in ``eval()``, so that a sample's rating does not depend on the batch that it is asked in.

    Logs ``q``, ``gamma_mix`` and ``bound``, the mean upper bound of the rating (eq. 12). Tuned by
    :class:`~torchrl_tsallis.QTuner`. Another reference density than the mixture is a subclass with another
    :meth:`log_reference`.

    Args:
        q: Tsallis index in [0, 1], the start value where it is tuned, or a sequence of them, one a stacked member; 1 is
            plain behavioral cloning.
        gamma_mix: relative rating level in [0, 1] or ``"adaptive"``, or a sequence, one a member; 0 is q-BC (absolute
            rating), 1 the pure relative rating.
        gamma_min: lower bound of the adaptive level.
        gamma_max: upper bound of the adaptive level.
        beta: see :class:`~torchrl_tsallis.ratings.Rating`.

    Raises:
        ValueError: if a setting is outside of its range.

    Examples:
        >>> TsallisRating(gamma_mix=0.0).needs_target, TsallisRating().needs_target
        (False, True)
    """

    saved_as = "tsallis"
    logged = ("q", "gamma_mix", "bound")

    q: Tensor
    gamma_low: Tensor
    gamma_high: Tensor

    def __init__(
        self,
        q: float | Sequence[float] = 0.8,
        gamma_mix: Level | Sequence[Level] = "adaptive",
        gamma_min: float = 0.1,
        gamma_max: float = 0.9,
        beta: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__(beta)
        gamma_min, gamma_max = _bound("gamma_min", gamma_min), _bound("gamma_max", gamma_max)
        if not 0 < gamma_min <= gamma_max < 1:
            raise ValueError(f"0 < gamma_min <= gamma_max < 1 is needed, got {gamma_min=} and {gamma_max=}")
        self.add_setting("q", q, 0, 1)
        # A fixed level is an adaptive one between equal bounds.
        self.add_setting("gamma_low", _levels(gamma_mix, gamma_min), 0, 1, argument="gamma_mix")
        self.add_setting("gamma_high", _levels(gamma_mix, gamma_max), 0, 1, argument="gamma_mix")
        self.moment = RunningMean()
        self._sort_members()

    @classmethod
    def settings_of(cls, state: Mapping[str, Tensor]) -> dict[str, Any]:
        """See :meth:`Rating.settings_of`; ``gamma`` are the two bounds of the level.

        Examples:
            >>> TsallisRating.settings_of(TsallisRating(q=0.75, gamma_mix=0.0).state_dict())
            {'q': 0.75, 'gamma': [0.0, 0.0], 'beta': 0.0}
        """
        q, low, high, beta = (float(state[name]) for name in ("q", "gamma_low", "gamma_high", "beta"))
        return {"q": q, "gamma": [low, high], "beta": beta}

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> TsallisRating:
        """See :meth:`Rating.from_settings`."""
        low, high = settings["gamma"]
        bounds = {"gamma_min": low, "gamma_max": high} if low < high else {"gamma_mix": low}
        return cls(q=settings["q"], beta=settings["beta"], **bounds)

    def _sort_members(self) -> None:
        """Keeps what decides about the course of a batch as Python values: to read a buffer would stall a GPU."""
        fixed = self.gamma_low == self.gamma_high
        self.needs_target = bool((self.gamma_high > 0).any())
        self._any_adaptive, self._all_adaptive = not bool(fixed.all()), not bool(fixed.any())
        some = (self.gamma_high > 0).any() and not (self.gamma_high > 0).all()
        self._target_members = self.gamma_high > 0 if self.gamma_high.ndim and some else None

    def stack(self, num_members: int | None) -> None:
        """See :meth:`Rating.stack`."""
        super().stack(num_members)
        self.moment.stack(num_members)
        self._sort_members()

    @property
    def target_members(self) -> Tensor | None:
        """See :attr:`Rating.target_members`; a member with gamma = 0 is not."""
        return self._target_members

    @property
    def variance_share(self) -> Tensor:
        """See :attr:`Rating.variance_share`; q for the absolute rating, 1 for plain behavioral cloning.

        Raises:
            NotImplementedError: for gamma > 0 and q < 1, where the target network's density counts too.
        """
        if bool(((self.gamma_high > 0) & (self.q < 1)).any()):
            raise NotImplementedError(
                "the fitted scale under a mixture with the target network is not known: use gamma_mix=0, or PeakRating"
            )
        return self.q

    def tuner(self) -> type[Any]:
        """:class:`~torchrl_tsallis.QTuner`."""
        from torchrl_tsallis.ratings.tsallis.tuner import QTuner

        return QTuner

    def gamma(self, moment: Tensor) -> Tensor:
        r"""The relative rating level (eq. 13) for :math:`\mathbb{E}[\pi^{1-q}]`, a scalar, or ``[S]`` with members."""
        low, high = self.gamma_low.to(moment), self.gamma_high.to(moment)
        if not self._any_adaptive:
            return low.expand_as(moment).clone()
        gamma = adaptive_gamma(moment, low, high)
        # A fixed level stays where the moment is NaN.
        return gamma if self._all_adaptive else low.where(low == high, gamma)

    def log_reference(self, evidence: Evidence, gamma: Tensor) -> Tensor:
        """Log-density of what the imitator is compared with, ``[*B]`` or a scalar; called without gradient.

        Args:
            evidence: of the batch.
            gamma: relative rating level, a scalar or ``[S]``.

        Returns:
            That of the mixture (eq. 10); 0 where no member has a target network.
        """
        if evidence.target_log_prob is None:
            return gamma.new_zeros(())
        target = evidence.target_log_prob
        return log_mixture(target, evidence.batch.spread(gamma, target))

    def forward(self, evidence: Evidence) -> Rated:
        """See :meth:`Rating.forward`."""
        batch, log_prob = evidence.batch, evidence.log_prob.detach()
        with torch.no_grad():
            q = batch.spread(self.q, log_prob)
            (moment,) = batch.mean(rating(log_prob, 0.0, q))
            if self._any_adaptive:
                moment = self.moment(moment)
            gamma = self.gamma(moment)
            value, weight = rated_value(log_prob, self.log_reference(evidence, gamma), q)
            logged = {"q": self.q.clone(), "gamma_mix": gamma, "bound": bound_ratio(moment, gamma=gamma)}
        return Rated(evidence.loss(value, weight), weight, log_prob, logged)


def _bound(name: str, value: Any) -> float:
    """A bound of the adaptive level: one number for all members."""
    number = as_numbers(name, value, 0, 1)
    if isinstance(number, list):
        raise ValueError(f"{name} must be one number in [0, 1] for all members, got {shown(value)}")
    return number


def _levels(gamma_mix: Any, bound: float) -> Any:
    """Relative rating levels with a bound in the place of the adaptive ones."""
    plain = gamma_mix.tolist() if isinstance(gamma_mix, (Tensor, np.ndarray)) else gamma_mix
    many = isinstance(plain, Sequence) and not isinstance(plain, str)
    levels = [
        bound if isinstance(level, str) and level == "adaptive" else level for level in (plain if many else [plain])
    ]
    try:
        numbers = as_numbers("gamma_mix", levels if many else levels[0], 0, 1)
    except ValueError:
        raise ValueError(
            f"gamma_mix must be 'adaptive' or a number in [0, 1], or a sequence, got {shown(gamma_mix)}"
        ) from None
    return numbers
