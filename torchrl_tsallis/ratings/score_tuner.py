"""Online tuning of the peak rating's rejection by the Hyvarinen score."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.peak import PeakRating
from torchrl_tsallis.ratings.tuner import MakeOptimizer, RatingTuner

if TYPE_CHECKING:
    from torchrl_tsallis.objectives.bc import TsallisBCLoss


def hyvarinen_score(distance: Tensor, u: Tensor, dims: float, batch: Batch | None = None) -> Tensor:
    r"""Hyvarinen score of the improper model :math:`f_u(a) = \exp\{-(1 - \rho) / u\}`, weighted by the variances.

    .. math:: H(u) = \mathbb{E}\left[w (2 u Z - 2 A) + w^2 Z\right] / A, \qquad w = e^{-u Z / 2}

    The score compares models that cannot be normalised; weighted by :math:`s_i^2` in each dimension it has no unit, and
    with mean and scale held fixed it stays proper for u.

    Source: Hyvarinen, JMLR 2005 (the score); Jewson & Rossell, JRSS-B 2022, and Sugasawa & Yonekura 2021 (the choice of
    a robust loss by it). The use inside of training, with the weighted form, is this project's.

    Args:
        distance: Z, ``[*B]``; no gradient flows into it.
        u: rejection, a scalar, or ``[S]`` with members.
        dims: A, the number of action dimensions.
        batch: valid samples, members and processes. Default: all samples, members where u is ``[S]``.

    Returns:
        H, a scalar or ``[S]``; lower is better.

    Examples:
        >>> hyvarinen_score(torch.tensor([2.0, 2.0]), torch.tensor(0.0), 2)  # 2 (w = 1): (-4 + 2) / 2
        tensor(-1.)
    """
    batch = batch or Batch(members=bool(u.ndim))
    z = distance.detach()
    wide = batch.spread(u, z)
    w = (-0.5 * wide * z).exp()
    return batch.mean((w * (2 * wide * z - 2 * dims) + w.square() * z) / dims)[0]


def score_gradient(distance: Tensor, u: Tensor, dims: float, batch: Batch | None = None) -> tuple[Tensor, Tensor]:
    r"""Value and derivative of :func:`hyvarinen_score` with respect to u, written out.

    .. math:: \frac{d H}{d u} = \mathbb{E}\left[w \{(A + 2) Z - u Z^2\} - w^2 Z^2\right] / A

    Args:
        distance: Z, ``[*B]``; no gradient flows into it.
        u: rejection, a scalar, or ``[S]`` with members.
        dims: A, the number of action dimensions.
        batch: valid samples, members and processes. Default: all samples, members where u is ``[S]``.

    Returns:
        H and its derivative, a scalar or ``[S]`` each, without graph.

    Examples:
        >>> score_gradient(torch.tensor([2.0, 2.0]), torch.tensor(0.0), 2)  # (4 * 2 - 4) / 2
        (tensor(-1.), tensor(2.))
    """
    batch = batch or Batch(members=bool(u.ndim))
    with torch.no_grad():
        z = distance
        wide = batch.spread(u, z)
        w = (-0.5 * wide * z).exp()
        wz, uz = w * z, wide * z
        value = w * (2 * uz - 2 * dims) + w * wz
        slope = wz * (dims + 2 - uz) - wz.square()
        score, derivative = batch.mean(value, slope)
        return score / dims, derivative / dims


class ScoreTuner(RatingTuner):
    r"""Finds how much the peak rating has to reject, by one gradient step on the Hyvarinen score each training step.

    .. math:: u(\phi) = u_{\max} \, \mathrm{sigmoid}(\phi), \qquad \min_\phi H(u(\phi))

    On normal data without outliers H rises with u, so that u runs to 0 and nothing is rejected without need. With gross
    outliers u settles where they just no longer count. There is no level, no multiplier and no bound that matters.
    Used as :class:`~torchrl_tsallis.QTuner` is: ``tuner.register(trainer)``, or ``tuner.step()`` after the policy's
    step.

    =========  ========  =======  ========
    symbol     argument  default  source
    =========  ========  =======  ========
    max u      u_max     0.5      measured
    step size  lr        3e-3     measured
    =========  ========  =======  ========

    Source: see :func:`hyvarinen_score`.

    Args:
        loss: the loss whose :class:`~torchrl_tsallis.PeakRating` is tuned, from its own u on.

    Keyword Args:
        tuned (sequence of bool): the stacked members whose u is tuned; the u of the others stays. Default: None, all.
        u_max (float): upper bound of u, in (0, 1). Default: 0.5.
        lr (float): step size of the tuner's own Adam. Default: 3e-3.
        optimizer (callable): makes another optimizer from a list of parameters. Default: None.

    Raises:
        ValueError: if a setting is outside of its range, or the loss has another rating; and in :meth:`step`, if the
            actor's distribution is no diagonal normal.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis import PeakRating, TsallisBCLoss
        >>> from torchrl_tsallis.modules import make_policy
        >>> loss = TsallisBCLoss(make_policy(3, 2), rating=PeakRating())
        >>> tuner = ScoreTuner(loss)
        >>> _ = loss(TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, [5]))
        >>> score = tuner.step()
        >>> round(loss.rating_module.u.item(), 4)
        0.1996
    """

    rating_class = PeakRating
    setting = "u"
    name = "score_tuner"

    def __init__(
        self,
        loss: TsallisBCLoss,
        *,
        tuned: Sequence[bool] | None = None,
        u_max: float = 0.5,
        lr: float = 3e-3,
        optimizer: MakeOptimizer | None = None,
    ) -> None:
        self.u_max = check_number("u_max", u_max, above=0, below=1)
        lr = check_number("lr", lr, low=0)
        if optimizer is None:
            optimizer = lambda params: torch.optim.Adam(params, lr=lr)  # noqa: E731
        super().__init__(loss, tuned=tuned, optimizer=optimizer)

    def start(self) -> Tensor:
        """See :meth:`RatingTuner.start`: the phi of the rating's own u."""
        share = self.rating.u / self.u_max
        inside = (share > 0) & (share < 1)
        if not bool((inside if self.tuned is None else inside | ~self.tuned).all()):
            raise ValueError(
                f"a tuned u must start in (0, {self.u_max:g}), the bound u_max of ScoreTuner, got {self.rating.u}"
            )
        return share.where(inside, 0.5).logit()

    def slope(self, evidence: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """See :meth:`RatingTuner.slope`; the evidence is the squared distance."""
        if self.rating.dims is None:
            raise ValueError(
                "ScoreTuner needs an actor whose distribution is a diagonal normal (or one under a bijection such as "
                "tanh): use a fixed u with others"
            )
        share = self.phi.sigmoid()
        score, by_u = score_gradient(evidence, self.u_max * share, self.rating.dims, batch)
        # A batch that is not finite moves nothing.
        return score, (by_u * self.u_max * share * (1 - share)).nan_to_num(0.0, 0.0, 0.0)

    def write(self, keep: Callable[[Tensor, Tensor], Tensor]) -> None:
        """See :meth:`RatingTuner.write`."""
        self.rating.u.copy_(keep(self.u_max * self.phi.sigmoid(), self.rating.u))
