"""A rating without units: the density relative to the imitator's own peak at that state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import is_tensor_collection
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Categorical, Distribution, OneHotCategorical

from torchrl_tsallis.ratings.base import Evidence, Rated, Rating
from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.normal import MAX_DISTANCE, diagonal_normal, squared_distance
from torchrl_tsallis.ratings.running import RunningMean

#: Typical squared distances a dimension over this say that the scale does not fit yet; a normal's is 1.
CALIBRATED = 2.0


def stretch(typical: Tensor) -> Tensor:
    """By what a squared scale is multiplied until it fits, for a typical squared distance T a dimension; at least 1.

    Examples:
        >>> stretch(torch.tensor([0.9, 2.0, 7.0]))
        tensor([1.0000, 1.0000, 3.5000])
    """
    return (typical / CALIBRATED).clamp_min(1.0)


def log_peak(dist: Distribution) -> Tensor:
    """Largest log-density of a distribution, ``[*B]``.

    Args:
        dist: batch shape ``[*B]``.

    Returns:
        The log-density at the peak.

    Raises:
        NotImplementedError: if the distribution knows no mode.

    Examples:
        >>> log_peak(Categorical(torch.tensor([0.25, 0.75]))).exp()
        tensor(0.7500)
    """
    if isinstance(dist, (Categorical, OneHotCategorical)):
        return dist.logits.max(-1).values
    if isinstance(dist, CompositeDistribution):
        return sum(log_peak(part) for part in dist.dists.values())  # type: ignore[return-value]
    try:
        mode = dist.deterministic_sample if hasattr(dist, "deterministic_sample") else dist.mode
        return dist.log_prob(mode)
    except NotImplementedError:
        raise NotImplementedError(
            f"PeakRating needs the mode of the actor's distribution, {type(dist).__name__} has none: use TsallisRating"
        ) from None


def peak_value(distance: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    r"""Loss and rating of every sample against the peak.

    .. math:: \rho = e^{-u Z / 2} = (\pi / \max_a \pi)^u, \qquad
        -\ln_{1-u} \frac{\pi}{\max_a \pi} = \frac{1 - \rho}{u}

    Args:
        distance: Z, twice the logarithm of the peak over the density, ``[*B]``.
        u: rejection, that broadcasts; 0 rates every sample 1, and the loss is Z / 2.

    Returns:
        The loss and the rating, ``[*B]`` each, without gradient.

    Examples:
        >>> peak_value(torch.tensor([0.0, 4.0]), torch.tensor(0.5))
        (tensor([0.0000, 1.2642]), tensor([1.0000, 0.3679]))
    """
    with torch.no_grad():
        exponent = -0.5 * u * distance
        plain = u == 0
        value = torch.where(plain, 0.5 * distance, -exponent.expm1() / torch.where(plain, 1.0, u))
        return value, exponent.exp()


class PeakRating(Rating):
    r"""Rates a sample by its density relative to the imitator's peak at that state.

    .. math:: \rho = \left(\frac{\pi(a|s)}{\max_{a'} \pi(a'|s)}\right)^u = e^{-u Z / 2}

    The second form is that of a diagonal normal with the squared standardised distance Z, also under a bijection such
    as tanh, in whose base space the peak is meant. The rating is in (0, 1] and has no unit: it is the same for actions
    in metres and in millimetres. Neither a target network nor gamma is needed. The gradient of the loss is the rating
    times that of the negative log-likelihood, mean and scale; its fixed point keeps the fitted variance at 1 - u of a
    true normal's, so that the scale neither collapses nor explodes.

    ======  ========  =======  ==============================================
    symbol  argument  default  source
    ======  ========  =======  ==============================================
    u       u         0.2      start value where it is tuned; measured
    beta    beta      0.5      Seitzer et al., ICLR 2022; measured
    ======  ========  =======  ==============================================

    **While the scale does not fit**, as in the first steps on actions of another size than the network's first outputs,
    all samples are many scales away, and a rating of Z would reject the lot. The typical distance of a dimension,
    :math:`T = 1 / \mathbb{E}[1 / (1 + Z/A)] - 1`, which outliers hardly move, tells this from noise: where T is over
    2, Z is divided by T / 2. On fitted data T is about 0.9, and it stays under 2 with up to a third of gross outliers.
    As a statistic of the batch its running mean is used in ``eval()``.

    Logs ``u`` and ``distance`` (T; 0 for other distributions). Tuned by :class:`~torchrl_tsallis.ScoreTuner`. For
    distributions other than diagonal normals Z is minus twice the logarithm of the density ratio; u is fixed then, and
    beta has to be 0.

    Source: this project, from the paper's relative rating; see ``docs/ratings.md``.

    Args:
        u: rejection in [0, 1], or a sequence, one a stacked member; 0 is plain behavioral cloning, 1 - q in the paper's
            symbols.
        beta: see :class:`~torchrl_tsallis.ratings.Rating`.

    Raises:
        ValueError: if a setting is outside of its range.

    Examples:
        >>> from torchrl_tsallis import TsallisBCLoss
        >>> from torchrl_tsallis.modules import make_policy
        >>> loss = TsallisBCLoss(make_policy(3, 2), rating=PeakRating(u=0.1))
        >>> loss.needs_target
        False
    """

    saved_as = "peak"
    logged = ("u", "distance")

    u: Tensor

    def __init__(self, u: float | Sequence[float] = 0.2, beta: float | Sequence[float] = 0.5) -> None:
        super().__init__(beta)
        self.add_setting("u", u, 0, 1)
        self.nearness = RunningMean(start=0.5)  # T = 1: the plain formula
        #: Action dimensions A of the last batch; None where its distribution is no diagonal normal.
        self.dims: float | None = None

    def stack(self, num_members: int | None) -> None:
        """See :meth:`Rating.stack`."""
        super().stack(num_members)
        self.nearness.stack(num_members)

    @property
    def variance_share(self) -> Tensor:
        """1 - u, see :attr:`Rating.variance_share`."""
        return 1 - self.u

    def tuner(self) -> type[Any]:
        """:class:`~torchrl_tsallis.ScoreTuner`."""
        from torchrl_tsallis.ratings.score_tuner import ScoreTuner

        return ScoreTuner

    def calibrated(self, distance: Tensor, dims: float, batch: Batch) -> tuple[Tensor, Tensor]:
        """Distances of a batch, made smaller while the scale does not fit; see above.

        Args:
            distance: Z, ``[*B]``, without gradient.
            dims: A, of how many dimensions.
            batch: whose samples they are.

        Returns:
            Z, ``[*B]``, and T, a scalar or ``[S]``; Z was divided by :func:`stretch` of T.
        """
        self.dims = dims
        (near,) = batch.mean((distance / dims + 1).reciprocal_())
        typical = self.nearness(near).reciprocal() - 1
        return distance / batch.spread(stretch(typical), distance), typical

    def forward(self, evidence: Evidence) -> Rated:
        """See :meth:`Rating.forward`."""
        batch = evidence.batch
        with torch.no_grad():
            normal = None if is_tensor_collection(evidence.action) else diagonal_normal(evidence.dist, evidence.action)
            if normal is None:
                self.dims = None
                log_ratio = evidence.log_prob.detach() - log_peak(evidence.dist)
                distance = (-2 * log_ratio).clamp(0, MAX_DISTANCE)
                typical = torch.zeros_like(self.u, dtype=distance.dtype)
            else:
                distance, typical = self.calibrated(squared_distance(normal), normal.loc.shape[-1], batch)
            value, weight = peak_value(distance, batch.spread(self.u.to(distance), distance))
        logged = {"u": self.u.clone(), "distance": typical}
        return Rated(evidence.loss(value, weight), weight, distance, logged)
