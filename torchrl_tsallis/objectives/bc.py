"""Behavioral cloning with Tsallis statistics: every method of the paper as one TorchRL loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, is_tensor_collection
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictSequential, dispatch
from tensordict.utils import NestedKey, expand_right, unravel_key
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.common import LossModule

from torchrl_tsallis.functional import bound_ratio, rated_nll, rating
from torchrl_tsallis.objectives.actor import get_dist
from torchrl_tsallis.objectives.reference import MixtureReference, ReferenceDensity
from torchrl_tsallis.objectives.statistics import rating_statistics


class TsallisBCLoss(LossModule):
    r"""Noise-robust behavioral cloning by adaptive absolute-relative ratings (eq. 10).

    .. math::
        L(\theta) = -\mathbb{E}\left[\pi_\gamma^{q-1} \ln_q \pi(a|s;\theta)\right], \qquad
        \nabla_\theta L = -\mathbb{E}\left[\rho \, \nabla_\theta \ln \pi\right], \quad
        \rho = (\pi / \pi_\gamma)^{1-q}

    Every method of the paper is a setting of this class:

    ==============================  ==========================================================
    plain BC (eq. 1)                ``q=1.0, gamma_mix=0.0``
    q-BC, absolute rating (eq. 6)   ``q=0.8, gamma_mix=0.0``
    q-KL, relative rating (eq. 8)   ``q=0.8, gamma_mix=1.0``
    adaptive gamma, fixed q         ``q=0.8``
    proposal                        ``q=0.8`` and a :class:`~torchrl_tsallis.QTuner`
    gamma = 0, tuned q              ``gamma_mix=0.0`` and a :class:`~torchrl_tsallis.QTuner`
    ==============================  ==========================================================

    Reads the observation keys of the actor and ``action`` (``[*B, A]``). Writes the keys below; all but the loss are
    detached scalars.

    ====================  =====================================================================
    ``loss_tsallis_bc``   the loss, a scalar, or ``[*B]`` with ``reduction="none"``
    ``q``, ``gamma_mix``  Tsallis index and relative rating level in force
    ``rating_mean``       mean of the rating
    ``rating_var``        (biased) variance of the rating
    ``ess``               effective sample size of the batch under the rating, in samples
    ``log_prob``          mean log-density of the batch
    ``bound``             mean upper bound of the rating (eq. 12)
    ====================  =====================================================================

    The target network exists only if the reference needs it. With a target network, a target updater such as
    :class:`~torchrl_tsallis.CATSoftUpdate` has to follow the policy.

    Source: Kobayashi & Aoyama, "Adaptive Absolute-Relative Rating for Noise Rejection in Behavioral Cloning based on
    Tsallis Statistics", SII 2025.

    Args:
        actor_network: stochastic actor; any whose ``get_dist`` gives a distribution with ``log_prob``.

    Keyword Args:
        q (float): Tsallis index in [0, 1], the start value where it is tuned. Default: 0.8.
        gamma_mix (float or "adaptive"): relative rating level in [0, 1]. Default: ``"adaptive"`` (eq. 13).
        gamma_min (float): lower bound of the adaptive level. Default: 0.1.
        gamma_max (float): upper bound of the adaptive level. Default: 0.9.
        reference (ReferenceDensity): another reference density than the paper's mixture; ``gamma_mix`` and its bounds
            are not used then. Default: None.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.

    Raises:
        ValueError: for a setting outside of its range, and in ``forward`` for shapes that do not fit.
        KeyError: in ``forward``, for a missing key.
        TypeError: in ``forward``, for mixed floating-point types.

    Examples:
        >>> from torchrl_tsallis.modules import make_policy
        >>> loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0)
        >>> data = TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, [5])
        >>> loss(data)["loss_tsallis_bc"].shape
        torch.Size([])
        >>> loss.rating(data).shape
        torch.Size([5])
    """

    @dataclass
    class _AcceptedKeys:
        """Configurable keys.

        Attributes:
            action: the demonstrated action. Default: ``"action"``.
        """

        action: NestedKey = "action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    out_keys = ["loss_tsallis_bc", "q", "gamma_mix", "rating_mean", "rating_var", "ess", "log_prob", "bound"]
    _schedulable_buffers = frozenset({"q"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        q: float = 0.8,
        gamma_mix: float | Literal["adaptive"] = "adaptive",
        gamma_min: float = 0.1,
        gamma_max: float = 0.9,
        reference: ReferenceDensity | None = None,
        reduction: Literal["mean", "sum", "none"] | None = None,
    ) -> None:
        super().__init__()
        if not 0 <= q <= 1:
            raise ValueError(f"q must be in [0, 1] (1 is plain behavioral cloning), got {q}")
        if reduction not in (None, "mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        self._in_keys: list[NestedKey] | None = None
        self.reference = reference or MixtureReference(gamma_mix, gamma_min, gamma_max)
        self.needs_target = self.reference.needs_target
        self.convert_to_functional(actor_network, "actor_network", create_target_params=self.needs_target)
        self.register_coeff_buffer("q", q)
        self.reduction = reduction or "mean"
        self._last_batch: tuple[Tensor, Tensor | None] | None = None

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Behavioral cloning has no value estimator to forward the keys to."""

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets the tensordict keys; see :class:`_AcceptedKeys`."""
        super().set_keys(**kwargs)
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """The action's key, then the actor's input keys, in the order in which ``dispatch`` takes them."""
        if self._in_keys is None:
            self._in_keys = [unravel_key(self.tensor_keys.action), *self.actor_network.in_keys]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def last_log_prob(self) -> Tensor:
        """Log-densities of the last batch that ``forward`` saw, valid samples only, detached, ``[N]``.

        Raises:
            RuntimeError: before the first ``forward``.
        """
        if self._last_batch is None:
            raise RuntimeError("no batch was rated yet: call the loss before what reads its log-densities")
        log_prob, mask = self._last_batch
        return log_prob.reshape(-1) if mask is None else log_prob[mask]

    def _mask(self, tensordict: TensorDictBase) -> Tensor | None:
        """The valid samples, ``[*B]`` bool; None where the batch carries no mask."""
        mask = None
        for key in self._loss_mask_keys():
            found = tensordict.get(key, None)
            if found is not None:
                found = self._expand_loss_mask(found, found.new_empty(tensordict.batch_size))
                mask = found if mask is None else mask & found
        return mask

    def _inputs(self, tensordict: TensorDictBase, mask: Tensor | None) -> TensorDictBase:
        """The actor's inputs and the action alone, checked; the caller's tensordict is never written to."""
        if 0 in tensordict.shape:
            raise ValueError(f"the batch of shape {list(tensordict.shape)} is empty: pass at least one sample")
        missing = [key for key in self.in_keys if key not in tensordict.keys(True)]
        if missing:
            raise KeyError(
                f"the batch has no {missing[0]!r}; it holds {sorted(map(str, tensordict.keys(True, True)))}. "
                f"Name the action's key by loss.set_keys(action=...) and the observations' by the actor's in_keys"
            )
        inputs = tensordict.select(*self.in_keys)
        if mask is not None:
            # Padding may hold NaN, which would reach the weights' gradients through 0 * NaN in the network.
            inputs = inputs.apply(lambda x: x.where(expand_right(mask, x.shape), torch.zeros_like(x)))
        action, observation = (inputs.get(key) for key in self.in_keys[:2])
        if is_tensor_collection(action) or is_tensor_collection(observation):
            return inputs
        if action.is_floating_point() and observation.is_floating_point() and action.dtype != observation.dtype:
            raise TypeError(
                f"mixed dtypes: {self.in_keys[0]!r} is {action.dtype}, {self.in_keys[1]!r} is {observation.dtype}; "
                "convert the data to one of them, for instance by tensordict.float()"
            )
        return inputs

    def _dist_log_prob(
        self, inputs: TensorDictBase, params: TensorDictParams
    ) -> tuple[torch.distributions.Distribution, Tensor]:
        with params.to_module(self.actor_network, preserve_module_state=False):
            dist = get_dist(self.actor_network, inputs)
        action = inputs.get(self.tensor_keys.action)
        if isinstance(dist, CompositeDistribution):
            log_prob = dist.log_prob(inputs)
            if is_tensor_collection(log_prob):
                log_prob = torch.stack(list(log_prob.values(True, True))).sum(0)
            return dist, log_prob
        expected = dist.batch_shape + dist.event_shape
        if dist.event_shape and action.shape != expected:  # broadcasting would hide it
            raise ValueError(
                f"{self.tensor_keys.action!r} has shape {list(action.shape)}, the actor's distribution "
                f"{list(expected)}: the two must be equal (check the actor's action_dim and the batch size)"
            )
        log_prob = dist.log_prob(action)
        if log_prob.shape != inputs.batch_size:
            raise ValueError(
                f"log_prob has shape {list(log_prob.shape)}, the batch {list(inputs.batch_size)}: give the batch its "
                "full batch size, and use a distribution that sums over the action's dimensions (IndependentNormal)"
            )
        return dist, log_prob

    def _rate(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
        """Log-density (with gradient), log reference, gamma, E[pi^(1-q)] and the mask."""
        mask = self._mask(tensordict)
        inputs = self._inputs(tensordict, mask)
        dist, log_prob = self._dist_log_prob(inputs, self.actor_network_params)
        with torch.no_grad():
            detached = log_prob.detach()
            target_log_prob = None
            if self.needs_target:
                _, target_log_prob = self._dist_log_prob(inputs, self.target_actor_network_params)
            density = rating(detached, 0.0, self.q)
            moment = density.mean() if mask is None else density[mask].mean()
            reference = self.reference(dist, target_log_prob, moment)
        return log_prob, reference.log_density, reference.gamma_mix, moment, mask

    def rating(self, tensordict: TensorDictBase) -> Tensor:
        """Rating of every sample (eq. 11): near 0 for what the imitator holds for noise.

        Args:
            tensordict: samples with the keys of ``in_keys``, ``[*B]``. An adaptive gamma takes its batch statistic
                from all of them.

        Returns:
            The rating, ``[*B]``.
        """
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(True):
            log_prob, log_reference, *_ = self._rate(tensordict)
            return rating(log_prob, log_reference, self.q)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss and its statistics.

        Args:
            tensordict: demonstrations with the keys of ``in_keys``, ``[*B]``; a mask under ``loss_mask_key`` selects.

        Returns:
            A tensordict with the keys of ``out_keys``.
        """
        log_prob, log_reference, gamma, moment, mask = self._rate(tensordict)
        per_sample, weights = rated_nll(log_prob, log_reference, self.q)
        out = {"loss_tsallis_bc": self._reduce_loss(per_sample, tensordict)}
        with torch.no_grad():
            detached = log_prob.detach()
            if not torch._C._functorch.is_batchedtensor(detached):  # would leak out of torch.vmap
                self._last_batch = (detached, mask)
            out["q"] = self.q.clone()
            out["gamma_mix"] = gamma
            out |= rating_statistics(weights, mask)
            out["log_prob"] = detached.mean() if mask is None else detached[mask].mean()
            out["bound"] = bound_ratio(moment, gamma=gamma)
        td_out = TensorDict(out, [])
        self._clear_weakrefs(tensordict, td_out, "actor_network_params", "target_actor_network_params")
        return td_out
