"""Behavioral cloning with Tsallis statistics: every method of the paper as one TorchRL loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.common import LossModule

from torchrl_tsallis.functional import bound_ratio, per_sample, rated_nll, rating
from torchrl_tsallis.objectives.actor import get_dist, get_stacked_dist, log_prob_of
from torchrl_tsallis.objectives.distributed import GlobalSum, global_sum, num_processes
from torchrl_tsallis.objectives.inputs import select_inputs
from torchrl_tsallis.objectives.members import per_member
from torchrl_tsallis.objectives.reference import MixtureReference, ReferenceDensity
from torchrl_tsallis.objectives.statistics import global_means, masked_mean, masked_sum, rating_statistics


class _Rated(NamedTuple):
    """What the loss knows of a batch: ``[*B]``, and statistics, scalars or ``[S]``."""

    log_prob: Tensor  # with gradient
    log_reference: Tensor
    gamma: Tensor
    moment: Tensor  # E[pi^(1-q)]
    mean_log_prob: Tensor
    num_valid: Tensor | None  # samples in all processes; None where there is only one
    mask: Tensor | None


def _as_leaf(x: Tensor) -> Tensor:
    """A copy that an optimizer takes, if there is a gradient to take."""
    return nn.Parameter(x.detach().clone()) if x.requires_grad else x.clone()


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

    Reads the observation keys of the actor and ``action`` (``[*B, A]``). A recurrent actor takes sequences
    ``[*B, T]``, of which every step is rated; its state, which it writes under ``next``, is read where it is given and
    zero where it is not. Writes the keys below; all but the loss are
    detached scalars, or ``[S]``.

    ====================  =====================================================================
    ``loss_tsallis_bc``   the loss, a scalar, or ``[*B]`` with ``reduction="none"``
    ``q``, ``gamma_mix``  Tsallis index and relative rating level in force
    ``rating_mean``       mean of the rating
    ``rating_var``        (biased) variance of the rating
    ``ess``               effective sample size of the batch under the rating, in samples
    ``log_prob``          mean log-density of the batch
    ``bound``             mean upper bound of the rating (eq. 12)
    ``member_loss``       only with stacked members: the loss of each, ``[S]``
    ====================  =====================================================================

    **Stacked members.** A list of S actors trains all of them as one program: parameters ``[S, ...]``, batches
    ``[S, *B]``, and with sequences for ``q`` and ``gamma_mix`` each member by its own method. The loss is the sum of
    the members' means, so that each has the gradient that it would have alone; every other output is ``[S]``. The
    optimizer has to keep members apart, as ``AdaTerm(loss.parameters(), batch_dims=1)`` does.

    **Data-parallel training.** Where ``torch.distributed`` is initialised, every statistic of the batch (gamma's
    moment, the bound, what is logged of the rating) is that of all processes' samples, and so is the q tuner's. With
    ``reduction="mean"`` the loss is scaled so that the average of the processes' gradients, as
    ``DistributedDataParallel`` takes it, is the gradient of the mean over all samples, also where their numbers differ
    by a mask. Every process has to call ``forward`` then; :meth:`rating` does not communicate.

    The target network exists only if the reference needs it. With a target network, a target updater such as
    :class:`~torchrl_tsallis.CATSoftUpdate` has to follow the policy.

    Source: Kobayashi & Aoyama, "Adaptive Absolute-Relative Rating for Noise Rejection in Behavioral Cloning based on
    Tsallis Statistics", SII 2025.

    Args:
        actor_network: stochastic actor; any whose ``get_dist`` gives a distribution with ``log_prob``. A list of them,
            alike but for their parameters, are stacked members.

    Keyword Args:
        q (float): Tsallis index in [0, 1], the start value where it is tuned, or a sequence of them, one a member.
            Default: 0.8.
        gamma_mix (float or "adaptive"): relative rating level in [0, 1], or a sequence, one a member.
            Default: ``"adaptive"`` (eq. 13).
        gamma_min (float): lower bound of the adaptive level. Default: 0.1.
        gamma_max (float): upper bound of the adaptive level. Default: 0.9.
        reference (ReferenceDensity): another reference density than the paper's mixture; ``gamma_mix`` and its bounds
            are not used then. Default: None.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.
        sync_stats (bool): take the statistics of the batch over all processes of ``torch.distributed``, where it is
            initialised. Default: True.
        process_group (ProcessGroup): these processes only. Default: None, all of them.

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
        actor_network: ProbabilisticTensorDictSequential | Sequence[ProbabilisticTensorDictSequential],
        *,
        q: float | Sequence[float] = 0.8,
        gamma_mix: float | Literal["adaptive"] | Sequence[float | Literal["adaptive"]] = "adaptive",
        gamma_min: float = 0.1,
        gamma_max: float = 0.9,
        reference: ReferenceDensity | None = None,
        reduction: Literal["mean", "sum", "none"] | None = None,
        sync_stats: bool = True,
        process_group: Any = None,
    ) -> None:
        super().__init__()
        members = None if isinstance(actor_network, nn.Module) else list(actor_network)
        self.num_members = None if members is None else len(members)
        q_values = per_member("q", q, self.num_members)
        if not all(0 <= value <= 1 for value in q_values):
            raise ValueError(f"q must be in [0, 1] (1 is plain behavioral cloning), got {q}")
        if reduction not in (None, "mean", "sum", "none"):
            raise ValueError(f"reduction must be 'mean', 'sum' or 'none', got {reduction!r}")
        self._in_keys: list[NestedKey] | None = None
        levels = per_member("gamma_mix", gamma_mix, self.num_members)
        self.reference = reference or MixtureReference(levels if members else levels[0], gamma_min, gamma_max)
        self.needs_target = self.reference.needs_target
        self.convert_to_functional(
            members or actor_network,
            "actor_network",
            expand_dim=self.num_members,
            create_target_params=self.needs_target,
        )
        if self.num_members == 1:  # TorchRL has expanded the parameters of a single module: they are leaves no more
            self.actor_network_params = TensorDictParams(self.actor_network_params.apply(_as_leaf), no_convert=True)
        self.register_buffer("q", torch.tensor(q_values if members else q_values[0]))
        self.reduction = reduction or "mean"
        self.sync_stats = sync_stats
        self.process_group = process_group
        if members and self.reduction != "none":
            self.out_keys = [*self.out_keys, "member_loss"]
        #: Which stacked members are rated by their target network, ``[S]`` bool; None for all of them.
        self.target_members: Tensor | None = None
        if members and reference is None and self.needs_target and 0.0 in levels:
            self.target_members = torch.tensor([level != 0 for level in levels])
        self._last_batch: tuple[Tensor, Tensor | None] | None = None

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Behavioral cloning has no value estimator to forward the keys to."""

    def train(self, mode: bool = True) -> TsallisBCLoss:
        """Sets the actor's mode too, which decides about dropout and noise; TorchRL keeps it out of its children."""
        super().train(mode)
        if "actor_network" in self.__dict__:
            self.actor_network.train(mode)
        return self

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

        With stacked members, whose numbers of valid samples differ, all samples, ``[S, N]``; see :attr:`last_mask`.

        Raises:
            RuntimeError: before the first ``forward``.
        """
        if self._last_batch is None:
            raise RuntimeError("no batch was rated yet: call the loss before what reads its log-densities")
        log_prob, mask = self._last_batch
        if self.num_members is not None:
            return log_prob.flatten(1)
        return log_prob.reshape(-1) if mask is None else log_prob[mask]

    @property
    def last_mask(self) -> Tensor | None:
        """Validity of the entries of :attr:`last_log_prob`, ``[S, N]``; None where all of them are valid."""
        if self.num_members is None or self._last_batch is None or self._last_batch[1] is None:
            return None
        return self._last_batch[1].flatten(1)

    def member_state_dict(self, member: int) -> dict[str, Tensor]:
        """State dict of the actor of one stacked member; ``actor.load_state_dict`` takes it.

        Args:
            member: index of the member, in the order of the actors that the loss was made of.

        Returns:
            Copies of the member's parameters, by the actor's own names.

        Raises:
            ValueError: if the loss has no stacked members.
        """
        if self.num_members is None:
            raise ValueError("the loss has one policy, not stacked members: use actor.state_dict()")
        params = self.actor_network_params.data[member].flatten_keys(".")
        return {name: value.clone() for name, value in params.items()}

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
        return select_inputs(tensordict, self.actor_network, self.in_keys, members=self.num_members, mask=mask)

    def _dist_log_prob(
        self, inputs: TensorDictBase, params: TensorDictBase
    ) -> tuple[torch.distributions.Distribution, Tensor]:
        if self.num_members is not None:
            dist = get_stacked_dist(self.actor_network, inputs, params, self.vmap_randomness)
        else:
            with params.to_module(self.actor_network, preserve_module_state=False):
                dist = get_dist(self.actor_network, inputs)
        return dist, log_prob_of(dist, inputs, self.tensor_keys.action)

    def _target_log_prob(self, inputs: TensorDictBase) -> Tensor:
        """The target network's log-density; 0 for members that are not rated by it, whose pass is saved."""
        params = self.target_actor_network_params
        if self.target_members is None:
            return self._dist_log_prob(inputs, params)[1]
        index = self.target_members.nonzero()[:, 0]
        some = self._dist_log_prob(inputs[index], params.data[index])[1]
        return some.new_zeros(inputs.shape).index_copy(0, index.to(some.device), some)

    @property
    def global_sum(self) -> GlobalSum | None:
        """Sums over the processes of data-parallel training; None where there is one, or without ``sync_stats``."""
        if not self.sync_stats or num_processes(self.process_group) == 1:
            return None
        return partial(global_sum, group=self.process_group)

    def _rate(self, tensordict: TensorDictBase, total: GlobalSum | None = None) -> _Rated:
        """Rates a batch, with its statistics over the processes that ``total`` sums over."""
        mask = self._mask(tensordict)
        inputs = self._inputs(tensordict, mask)
        dist, log_prob = self._dist_log_prob(inputs, self.actor_network_params)
        with torch.no_grad():
            detached = log_prob.detach()
            target_log_prob = None
            if self.needs_target:
                target_log_prob = self._target_log_prob(inputs)
            density = rating(detached, 0.0, per_sample(self.q, detached))
            (moment, mean), count = global_means([density, detached], mask, self.num_members is not None, total)
            reference = self.reference(dist, target_log_prob, moment)
        return _Rated(log_prob, reference.log_density, reference.gamma_mix, moment, mean, count, mask)

    def _reduce(self, losses: Tensor, rated: _Rated, tensordict: TensorDictBase) -> Tensor:
        """The losses as they are, or their mean or sum, ``[S]`` with members.

        Of several processes, the mean is this process's share of it times their number.
        """
        members, mask = self.num_members is not None, rated.mask
        if self.reduction == "mean" and rated.num_valid is not None:
            scale = num_processes(self.process_group) / rated.num_valid.clamp_min(1)
            return masked_sum(losses, mask, members) * scale.to(losses)
        if not members or self.reduction == "none":
            return self._reduce_loss(losses, tensordict)
        return (masked_mean if self.reduction == "mean" else masked_sum)(losses, mask, True)

    def rating(self, tensordict: TensorDictBase) -> Tensor:
        """Rating of every sample (eq. 11): near 0 for what the imitator holds for noise.

        Args:
            tensordict: samples with the keys of ``in_keys``, ``[*B]``. An adaptive gamma takes its batch statistic
                from all of them.

        Returns:
            The rating, ``[*B]``.
        """
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(True):
            rated = self._rate(tensordict)
            return rating(rated.log_prob, rated.log_reference, per_sample(self.q, rated.log_prob))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss and its statistics.

        Args:
            tensordict: demonstrations with the keys of ``in_keys``, ``[*B]``; a mask under ``loss_mask_key`` selects.

        Returns:
            A tensordict with the keys of ``out_keys``.
        """
        total, members = self.global_sum, self.num_members is not None
        rated = self._rate(tensordict, total)
        losses, weights = rated_nll(rated.log_prob, rated.log_reference, per_sample(self.q, rated.log_prob))
        out = {"loss_tsallis_bc": self._reduce(losses, rated, tensordict)}
        if members and self.reduction != "none":
            # The sum over members: each gets the gradient that it would have by itself.
            of_member = out["loss_tsallis_bc"]
            out = {"loss_tsallis_bc": of_member.sum(), "member_loss": of_member.detach()}
        with torch.no_grad():
            detached = rated.log_prob.detach()
            if not torch._C._functorch.is_batchedtensor(detached):  # would leak out of torch.vmap
                self._last_batch = (detached, rated.mask)
            out["q"] = self.q.clone()
            out["gamma_mix"] = rated.gamma
            out |= rating_statistics(weights, rated.mask, members, total)
            out["log_prob"] = rated.mean_log_prob
            out["bound"] = bound_ratio(rated.moment, gamma=rated.gamma)
        td_out = TensorDict(out, [])
        self._clear_weakrefs(tensordict, td_out, "actor_network_params", "target_actor_network_params")
        return td_out
