"""Online tuning of the Tsallis index q (section IV-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_tsallis.functional import MAX_EXPONENT, bound_ratio, density_moment
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.distributed import GlobalSum
from torchrl_tsallis.objectives.reference import MixtureReference
from torchrl_tsallis.optim import AdaTerm


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
    mask: Tensor | None = None,
    total: GlobalSum | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Value and derivative of :func:`q_objective`, written out: a third of autograd's cost.

    .. math:: \frac{d L}{d \phi} = \left(1 + \lambda \, \mathrm{sgn}(b - 1) \frac{d b}{d q}\right) \frac{d q}{d \phi},
        \qquad \frac{d b}{d q} = \frac{-\mathbb{E}[\pi^{1-q} \ln \pi]}{1 - \gamma}

    with the bound b; its derivative is 0 where gamma is not clipped, because b is 1 there for every q.

    Args:
        log_prob: as there, and so are all the others.
        phi: as there.
        q_min: as there.
        multiplier: as there.
        gamma_min: as there, or ``[*S]`` together with the other one. A fixed gamma is one between equal bounds.
        gamma_max: as there.
        gamma: as there.
        mask: valid samples, ``[*S, B]`` bool. Default: all of them.
        total: sums over the processes of data-parallel training. Default: None, there is only one.

    Returns:
        The objective and its derivative with respect to phi, ``[*S]`` each, without graph.

    Examples:
        >>> value, slope = q_gradient(torch.full((4,), -1.0), torch.tensor(0.0))
        >>> value, slope  # q alone is left, with the slope 0.4 / 4
        (tensor(0.8000), tensor(0.1000))
    """
    with torch.no_grad():
        share = phi.sigmoid()
        u = (1 - share).mul_(1 - q_min)  # 1 - q
        exponent = u.unsqueeze(-1) * log_prob
        density = exponent.clamp(max=MAX_EXPONENT).exp_()
        slopes = (density * log_prob).where(exponent <= MAX_EXPONENT, 0.0)
        if mask is None and total is None:
            moment, slope = density.mean(-1), -slopes.mean(-1)
        else:
            valid = torch.ones_like(density, dtype=torch.bool) if mask is None else mask
            sums = density.where(valid, 0.0).sum(-1), slopes.where(valid, 0.0).sum(-1), valid.sum(-1)
            moment, slope, count = sums if total is None else total(*sums)
            count = count.clamp_min(1).to(moment)
            moment, slope = moment / count, -slope / count
        if gamma is None:
            rest = moment.clamp(1 - gamma_max, 1 - gamma_min)  # type: ignore[arg-type]  # 1 - gamma
            slope = slope.where(rest != moment, 0.0)
        else:
            rest = torch.as_tensor(1 - gamma, dtype=moment.dtype, device=moment.device)
        excess = moment / rest - 1
        by_q = excess.sign().mul_(slope).div_(rest).mul_(multiplier).add_(1)
        return excess.abs_().mul_(multiplier).add_(1 - u), by_q.mul_(u).mul_(share)


class QTuner(TrainerHookBase):
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
        ValueError: if a setting is outside of its range, or the loss rates by another reference than the mixture
            or with gamma = 1, for which eq. 15 is not defined.

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

    def __init__(
        self,
        loss: TsallisBCLoss,
        *,
        tuned: Sequence[bool] | None = None,
        q_min: float = 0.6,
        multiplier: float = 100.0,
        lr: float = 1e-3,
        optimizer: Callable[[list[nn.Parameter]], torch.optim.Optimizer] | None = None,
    ) -> None:
        if not 0 < q_min < 1:
            raise ValueError(f"q_min must be in (0, 1), got {q_min}")
        if multiplier < 0:
            raise ValueError(f"multiplier must not be negative, got {multiplier}")
        reference = loss.reference
        if tuned is not None and len(tuned) != loss.num_members:
            raise ValueError(f"tuned has {len(tuned)} values for {loss.num_members or 'no'} stacked members")
        switches = tuned or [True] * (loss.num_members or 1)
        if not isinstance(reference, MixtureReference) or any(
            level == 1 and on for level, on in zip(reference.levels, switches, strict=True)
        ):
            raise ValueError(
                "QTuner needs a loss with the paper's mixture and gamma_mix < 1: eq. 15 divides by 1 - gamma; "
                "use a fixed q with other references"
            )
        self.loss = loss
        self.reference = reference
        self.q_min = q_min
        self.multiplier = multiplier
        self.tuned = None if tuned is None or all(tuned) else torch.tensor(tuned, device=loss.q.device)
        self.phi = nn.Parameter(torch.zeros_like(loss.q))
        self.optimizer = optimizer([self.phi]) if optimizer else AdaTerm([self.phi], lr=lr, batch_dims=self.phi.ndim)
        self._write_q()

    def _write_q(self) -> None:
        with torch.no_grad():
            q = q_of_phi(self.phi, self.q_min)
            self.loss.q.copy_(q if self.tuned is None else q.where(self.tuned, self.loss.q))

    def step(self, log_prob: Tensor | None = None) -> Tensor:
        """One step of the tuner.

        Args:
            log_prob: log-densities of a batch, ``[N]``; ``[S, N]`` with members. Default: those of the loss's last
                ``forward``.

        Returns:
            The objective before the step, a detached scalar; ``[S]`` with members, 0 where q is not tuned.
        """
        gamma_min, gamma_max = self.reference.bounds
        objective, slope = q_gradient(
            self.loss.last_log_prob if log_prob is None else log_prob.detach(),
            self.phi,
            q_min=self.q_min,
            multiplier=self.multiplier,
            gamma_min=gamma_min,
            gamma_max=gamma_max,
            mask=self.loss.last_mask if log_prob is None else None,
            total=self.loss.global_sum,
        )
        if self.tuned is not None:
            objective, slope = objective.where(self.tuned, 0.0), slope.where(self.tuned, 0.0)
        self.phi.grad = slope
        self.optimizer.step()
        self._write_q()
        return objective

    def __call__(self) -> None:
        """The trainer's hook: one step."""
        self.step()

    def register(self, trainer: Trainer, name: str = "q_tuner") -> None:
        """Registers the tuner after each optimizer step, and for checkpoints."""
        trainer.register_op("post_optim", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        """State: phi and its optimizer's."""
        return {"phi": self.phi.detach().clone(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state and writes q into the loss."""
        with torch.no_grad():
            self.phi.copy_(state_dict["phi"])
        self.optimizer.load_state_dict(state_dict["optimizer"])
        self._write_q()
