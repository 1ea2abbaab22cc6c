r"""The method's equations as pure functions of log-densities.

A density is never formed on its own: everything takes and returns logarithms, so that log-densities from -1e4 (an
action that the imitator rules out) to +60 (a collapsed scale in many dimensions) give finite values and gradients in
float32. Equation numbers are those of Kobayashi & Aoyama, SII 2025.

===========  ===============  ==========================================================
symbol       argument         meaning
===========  ===============  ==========================================================
ln pi        log_prob         imitator's log-density at the dataset's action, ``[*B]``
ln pibar     target_log_prob  the target network's, ``[*B]``
q            q                Tsallis index in [0, 1]; 1 is plain behavioral cloning
gamma        gamma            relative rating level in [0, 1]; 0 is the absolute rating
===========  ===============  ==========================================================
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_tsallis.ratings.base import weighted_loss
from torchrl_tsallis.ratings.tsallis.q_logarithm import MAX_EXPONENT, _QLogarithm, as_like, exp_q, ln_q

__all__ = [
    "MAX_EXPONENT",
    "adaptive_gamma",
    "bound_ratio",
    "density_moment",
    "exp_q",
    "ln_q",
    "log_mixture",
    "rated_nll",
    "rated_value",
    "rating",
    "tsallis_nll",
]


def log_mixture(target_log_prob: Tensor, gamma: float | Tensor) -> Tensor:
    r"""Logarithm of the paper's reference density (eq. 10).

    .. math:: \ln \pi_\gamma = \ln\{(1-\gamma) + \gamma \bar\pi\}

    Args:
        target_log_prob: log-density under the target network, ``[*B]``.
        gamma: relative rating level in [0, 1], a number or a tensor that broadcasts.

    Returns:
        The log-density of the mixture, ``[*B]``; 0 at ``gamma = 0`` and ``target_log_prob`` at ``gamma = 1``.

    Examples:
        >>> log_mixture(torch.tensor([-1e4, 0.0]), 0.5)
        tensor([-0.6931,  0.0000])
    """
    gamma = as_like(gamma, target_log_prob)
    if not torch.is_grad_enabled():  # the limits are right by themselves, their gradients would not be
        return torch.logaddexp(torch.log1p(-gamma), gamma.log() + target_log_prob)
    inner = (gamma > 0) & (gamma < 1)
    safe = torch.where(inner, gamma, 0.5)  # keeps log(0) out of the branch that is not taken, and of its gradient
    mixed = torch.logaddexp(torch.log1p(-safe), safe.log() + target_log_prob)
    return torch.where(inner, mixed, torch.where(gamma > 0, target_log_prob, torch.zeros_like(mixed)))


def rating(log_prob: Tensor, log_reference: float | Tensor, q: float | Tensor) -> Tensor:
    r"""Implicit weight of a sample (eqs. 7, 9 and 11): its gradient relative to plain BC's.

    .. math:: \rho = (\pi / \pi_\gamma)^{1-q}

    Args:
        log_prob: imitator's log-density, ``[*B]``.
        log_reference: log-density of the reference, ``[*B]`` or a number (0 for the absolute rating).
        q: Tsallis index.

    Returns:
        The rating, ``[*B]``, in ``[0, exp(64)]``; all ones at ``q = 1``.

    Examples:
        >>> rating(torch.tensor([-10.0, 0.0]), 0.0, 0.8)
        tensor([0.1353, 1.0000])
    """
    u = 1 - as_like(q, log_prob)
    # An action of density 0 is still rated 1 at q = 1, where 0 * inf would be NaN.
    return (u * (log_prob - log_reference)).where(u != 0, 0.0).clamp(max=MAX_EXPONENT).exp()


def tsallis_nll(log_prob: Tensor, log_reference: float | Tensor, q: float | Tensor) -> Tensor:
    r"""The loss of every sample (eq. 10), with the reference density held constant.

    .. math:: -\pi_\gamma^{q-1} \ln_q \pi = -\left(\ln_q \frac{\pi}{\pi_\gamma} - \ln_q \frac{1}{\pi_\gamma}\right)

    The right-hand side, by the pseudo-additivity of eq. 5, is what is computed: a large weight and a small
    ``ln_q`` are never multiplied.

    Args:
        log_prob: imitator's log-density, ``[*B]``.
        log_reference: log-density of the reference, ``[*B]`` or a number; no gradient flows into it.
        q: Tsallis index.

    Returns:
        The loss, ``[*B]``; its gradient with respect to ``log_prob`` is minus the :func:`rating`. At ``q = 1`` it is
        the negative log-likelihood, whatever the reference.

    Examples:
        >>> tsallis_nll(torch.tensor([-3.0, 0.5]), 0.0, 1.0)
        tensor([ 3.0000, -0.5000])
    """
    reference, q = as_like(log_reference, log_prob).detach(), as_like(q, log_prob)
    # Without a gradient the plain formula will do; an autograd Function costs four times as much.
    constant = ln_q(-reference, q) if q.requires_grad else _QLogarithm.forward(-reference, q)
    return constant - ln_q(log_prob - reference, q)


def rated_value(log_prob: Tensor, log_reference: float | Tensor, q: float | Tensor) -> tuple[Tensor, Tensor]:
    r"""Loss and rating of every sample, as :func:`tsallis_nll` and :func:`rating` give them, for less than one of them.

    Args:
        log_prob: imitator's log-density, ``[*B]``; no gradient flows through either result.
        log_reference: log-density of the reference, ``[*B]`` or a number.
        q: Tsallis index.

    Returns:
        The loss and the rating, ``[*B]`` each.

    Examples:
        >>> rated_value(torch.tensor([-10.0, -1.0]), 0.0, 0.8)
        (tensor([4.3233, 0.9063]), tensor([0.1353, 0.8187]))
    """
    with torch.no_grad():
        reference = as_like(log_reference, log_prob)
        u = 1 - as_like(q, log_prob)
        plain = u == 0
        z = (u * (log_prob - reference)).masked_fill(plain, 0.0).clamp(max=MAX_EXPONENT)
        # ln_q(1 / reference) - ln_q(pi / reference); a reference of 1 has no first part
        value = (-u * reference).clamp(max=MAX_EXPONENT).expm1() - z.expm1()
        return torch.where(plain, -log_prob, value / torch.where(plain, 1.0, u)), z.exp()


def rated_nll(log_prob: Tensor, log_reference: float | Tensor, q: float | Tensor) -> tuple[Tensor, Tensor]:
    r"""The loss of every sample with a gradient, and its rating.

    The loss is a surrogate, ``value - rating * (log_prob - log_prob.detach())`` with the value and rating of
    :func:`rated_value`: its first derivative is exact, there is no second one, and none with respect to q or the
    reference.

    Args:
        log_prob: imitator's log-density, ``[*B]``.
        log_reference: log-density of the reference, ``[*B]`` or a number.
        q: Tsallis index.

    Returns:
        The loss, ``[*B]``, whose gradient with respect to ``log_prob`` is minus the rating, and the rating without
        graph, ``[*B]``.

    Examples:
        >>> x = torch.tensor([-10.0, -1.0], requires_grad=True)
        >>> loss, weight = rated_nll(x, 0.0, 0.8)
        >>> torch.autograd.grad(loss.sum(), x)
        (tensor([-0.1353, -0.8187]),)
    """
    value, weight = rated_value(log_prob.detach(), log_reference, q)
    return weighted_loss(value, weight, log_prob), weight


def density_moment(log_prob: Tensor, q: float | Tensor, dim: int = -1) -> Tensor:
    r"""Batch estimate of :math:`\mathbb{E}[\pi^{1-q}]`, which drives gamma and q (eqs. 12-15).

    Args:
        log_prob: imitator's log-density, ``[*S, B]``.
        q: Tsallis index, a number or ``[*S]``.
        dim: the batch dimension that is averaged over.

    Returns:
        The mean, ``[*S]``.

    Raises:
        ValueError: if the batch is empty.

    Examples:
        >>> density_moment(torch.tensor([0.0, -1e4]), 0.5)
        tensor(0.5000)
    """
    if log_prob.shape[dim] == 0:
        raise ValueError(
            f"log_prob of shape {list(log_prob.shape)} has no sample along dim {dim}, so that E[pi^(1-q)] does not "
            "exist: pass a batch with at least one sample (check that the mask is not False everywhere)"
        )
    u = 1 - as_like(q, log_prob)
    if u.ndim:
        u = u.unsqueeze(dim)
    return (u * log_prob).clamp(max=MAX_EXPONENT).exp().mean(dim)


def adaptive_gamma(moment: Tensor, gamma_min: float | Tensor = 0.1, gamma_max: float | Tensor = 0.9) -> Tensor:
    r"""The relative rating level that fixes the mean bound of the rating at one (eq. 13).

    .. math:: \gamma = \mathrm{clip}(1 - \mathbb{E}[\pi^{1-q}], \underline\gamma, \overline\gamma)

    Args:
        moment: :math:`\mathbb{E}[\pi^{1-q}]` from :func:`density_moment`, ``[*S]``.
        gamma_min: lower bound (0.1, section V-B), leaves the relative rating room to act. A number, or ``[*S]``
            together with the other one.
        gamma_max: upper bound (0.9, section V-B), keeps the bound of the rating finite.

    Returns:
        gamma, ``[*S]``.

    Examples:
        >>> adaptive_gamma(torch.tensor([0.0, 0.6, 1.3]))
        tensor([0.9000, 0.4000, 0.1000])
    """
    return (1 - moment).clamp(gamma_min, gamma_max)  # type: ignore[arg-type]


def bound_ratio(
    moment: Tensor, gamma_min: float = 0.1, gamma_max: float = 0.9, gamma: float | Tensor | None = None
) -> Tensor:
    r"""Mean upper bound of the rating (eq. 12), :math:`\mathbb{E}[\pi^{1-q}] / (1-\gamma)`.

    With the adaptive gamma of eq. 13 the denominator is the moment itself wherever gamma is not clipped, so that the
    ratio is exactly 1 there and its gradient exactly 0: gradients flow through the clip.

    Args:
        moment: :math:`\mathbb{E}[\pi^{1-q}]`, ``[*S]``.
        gamma_min: lower bound of the adaptive gamma.
        gamma_max: upper bound of the adaptive gamma.
        gamma: a fixed gamma < 1 instead of the adaptive one.

    Returns:
        The bound, ``[*S]``; infinite for ``gamma = 1``.

    Examples:
        >>> bound_ratio(torch.tensor([0.05, 0.6, 1.8]))
        tensor([0.5000, 1.0000, 2.0000])
        >>> bound_ratio(torch.tensor(0.6), gamma=0.0)
        tensor(0.6000)
    """
    if gamma is not None:
        return moment / (1 - as_like(gamma, moment))
    return moment / moment.clamp(1 - gamma_max, 1 - gamma_min)
