"""Online tuning of the Tsallis index q (section IV-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.optim import AdaTerm
from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.tsallis.equations import MAX_EXPONENT, bound_ratio, density_moment
from torchrl_tsallis.ratings.tsallis.rating import TsallisRating
from torchrl_tsallis.ratings.tuner import MakeOptimizer, RatingTuner

if TYPE_CHECKING:
    from torchrl_tsallis.objectives.bc import TsallisBCLoss

#: Log-densities are cut here: times a density of 0 they must give 0.
_LEAST = -1e30


def q_of_phi(phi: Tensor, q_min: float = 0.6) -> Tensor:
    """Maps the q tuner's free parameter to q in (q_min, 1) (eq. 15).

    Args:
        phi: free parameter, ``[*S]``; 0 gives the middle of the range.
        q_min: lower bound of q (0.6, section V-B).

    Returns:
        q, ``[*S]``.

    Examples:
        >>> q_of_phi(torch.tensor(0.0))
        tensor(0.8000)
    """
    return q_min + (1 - q_min) * phi.sigmoid()


def q_objective(
    log_prob: Tensor,
    phi: Tensor,
    *,
    q_min: float = 0.6,
    multiplier: float = 100.0,
    gamma_min: float = 0.1,
    gamma_max: float = 0.9,
    gamma: float | Tensor | None = None,
) -> Tensor:
    r"""What the q tuner minimises (eq. 15): the smallest q for which the mean bound of the rating is one.

    .. math:: L(\phi) = q(\phi) + \lambda \left| \frac{\mathbb{E}[\pi^{1-q(\phi)}]}{1-\gamma(\phi)} - 1 \right|

    Args:
        log_prob: imitator's log-density, ``[*S, B]``; no gradient flows into it.
        phi: free parameter of q, ``[*S]``.
        q_min: lower bound of q.
        multiplier: Lagrange multiplier lambda.
        gamma_min: lower bound of the adaptive gamma.
        gamma_max: upper bound of the adaptive gamma.
        gamma: a fixed gamma instead of the adaptive one.

    Returns:
        The objective, ``[*S]``.

    Examples:
        >>> q_objective(torch.full((4,), -1.0), torch.tensor(0.0))  # gamma is not clipped: q alone is left
        tensor(0.8000)
    """
    q = q_of_phi(phi, q_min)
    moment = density_moment(log_prob.detach(), q)
    return q + multiplier * (bound_ratio(moment, gamma_min, gamma_max, gamma) - 1).abs()


def q_gradient(
    log_prob: Tensor,
    phi: Tensor,
    *,
    q_min: float = 0.6,
    multiplier: float = 100.0,
    gamma_min: float | Tensor = 0.1,
    gamma_max: float | Tensor = 0.9,
    gamma: float | Tensor | None = None,
    batch: Batch | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Value and derivative of :func:`q_objective`, written out: a third of autograd's cost.

    .. math:: \frac{d L}{d \phi} = \left(1 + \lambda \, \mathrm{sgn}(b - 1) \frac{d b}{d q}\right) \frac{d q}{d \phi},
        \qquad \frac{d b}{d q} = \frac{-\mathbb{E}[\pi^{1-q} \ln \pi]}{1 - \gamma}

    with the bound b; its derivative is 0 where gamma is not clipped, because b is 1 there for every q. Close to q = 1
    the sign of b - 1 is that of :math:`\mathbb{E}[\pi^{1-q} - 1]`, which is computed without cancellation.

    Args:
        log_prob: imitator's log-density, ``[*B]``; ``[S, *B]`` with members.
        phi: free parameter of q, a scalar, or ``[S]`` with members.
        q_min: lower bound of q.
        multiplier: Lagrange multiplier lambda.
        gamma_min: lower bound of the adaptive gamma, or ``[S]`` together with the upper one. A fixed gamma is one
            between equal bounds.
        gamma_max: upper bound of the adaptive gamma.
        gamma: a fixed gamma instead of the adaptive one.
        batch: valid samples, members and processes. Default: all samples, members where phi is ``[S]``.

    Returns:
        The objective and its derivative with respect to phi, ``[*S]`` each, without graph.

    Examples:
        >>> value, slope = q_gradient(torch.full((4,), -1.0), torch.tensor(0.0))
        >>> value, slope  # q alone is left, with the slope 0.4 / 4
        (tensor(0.8000), tensor(0.1000))
    """
    batch = batch or Batch(members=bool(phi.ndim))
    with torch.no_grad():
        u = (-phi).sigmoid().mul_(1 - q_min)  # 1 - q, right to the last digit also where q is 1 but for that
        log_prob = log_prob.clamp(min=_LEAST)
        exponent = batch.spread(u, log_prob) * log_prob
        capped = exponent.clamp(max=MAX_EXPONENT)
        slopes = (capped.exp() * log_prob).where(exponent <= MAX_EXPONENT, 0.0)
        excess, slope = batch.mean(capped.expm1_(), slopes)  # E[pi^(1-q)] - 1, and minus its derivative by q
        if gamma is None:
            # 1 - gamma, less 1, between the bounds; where it is the moment's own excess, the bound is 1 for every q
            rest = excess.clamp(-gamma_max, -gamma_min)  # type: ignore[arg-type]
            slope = slope.where(rest != excess, 0.0)
        else:
            rest = torch.as_tensor(-gamma, dtype=excess.dtype, device=excess.device)
        above = (excess - rest) / (1 + rest)  # b - 1
        by_q = above.sign().mul_(slope).div_(1 + rest).mul_(-multiplier).add_(1)
        return above.abs_().mul_(multiplier).add_(1 - u), by_q.mul_(u).mul_(phi.sigmoid())


class QTuner(RatingTuner):
    r"""Lowers q as far as the ratings' mean bound stays at one (eqs. 14-15), one step each training step.

    Usable as a hook of TorchRL's trainer (``tuner.register(trainer)``) and in a hand-written loop, by a call of
    ``tuner.step()`` after the policy's step. It takes the log-densities that the loss has just computed, and writes
    the new q into ``loss.q``.

    ==========  ===========  =======  ============
    symbol      argument     default  source
    ==========  ===========  =======  ============
    min q       q_min        0.6      section V-B
    lambda      multiplier   100      section V-B
    step size   lr           1e-3     as the policy's
    ==========  ===========  =======  ============

    In data-parallel training the moment and its slope are those of all processes' samples, so that q is the same in
    each of them.

    With S stacked members there is one phi for each, ``[S]``; ``tuned`` says whose q moves.

    Args:
        loss: the loss whose q is tuned. Its q becomes the middle of (q_min, 1).

    Keyword Args:
        tuned (sequence of bool): the stacked members whose q is tuned; the q of the others stays. Default: None, all.
        q_min (float): lower bound of q. Default: 0.6.
        multiplier (float): Lagrange multiplier lambda. Default: 100.
        lr (float): step size of the tuner's own AdaTerm. Default: 1e-3.
        optimizer (callable): makes another optimizer from a list of parameters. Default: None.

    Raises:
        ValueError: if a setting is outside of its range, or the loss has another rating, or one with gamma = 1, for
            which eq. 15 is not defined.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis import TsallisBCLoss
        >>> from torchrl_tsallis.modules import make_policy
        >>> loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0)
        >>> tuner = QTuner(loss)
        >>> _ = loss(TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, [5]))
        >>> objective = tuner.step()
        >>> 0.6 < loss.q.item() < 1
        True
    """

    rating_class = TsallisRating
    setting = "q"
    name = "q_tuner"

    def __init__(
        self,
        loss: TsallisBCLoss,
        *,
        tuned: Sequence[bool] | None = None,
        q_min: float = 0.6,
        multiplier: float = 100.0,
        lr: float = 1e-3,
        optimizer: MakeOptimizer | None = None,
    ) -> None:
        self.q_min = check_number("q_min", q_min, above=0, below=1)
        self.multiplier = check_number("multiplier", multiplier, low=0)
        lr = check_number("lr", lr, low=0)
        if optimizer is None:
            optimizer = lambda params: AdaTerm(params, lr=lr, batch_dims=params[0].ndim)  # noqa: E731
        super().__init__(loss, tuned=tuned, optimizer=optimizer)
        relative = self.rating.gamma_low == 1
        if bool((relative if self.tuned is None else relative & self.tuned).any()):
            raise ValueError(
                "QTuner needs gamma_mix < 1: eq. 15 divides by 1 - gamma; use a fixed q with the pure relative rating"
            )

    def slope(self, evidence: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
        """See :meth:`RatingTuner.slope`; the evidence is the log-density."""
        low, high = self.rating.gamma_low.to(evidence), self.rating.gamma_high.to(evidence)
        settings = {"q_min": self.q_min, "multiplier": self.multiplier, "gamma_min": low, "gamma_max": high}
        return q_gradient(evidence, self.phi, **settings, batch=batch)

    def write(self, keep: Callable[[Tensor, Tensor], Tensor]) -> None:
        """See :meth:`RatingTuner.write`."""
        self.rating.q.copy_(keep(q_of_phi(self.phi, self.q_min), self.rating.q))
