"""Behavioral cloning whose samples are rated: every method of the paper, and others, as one TorchRL loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_tsallis._checks import check_choice, check_flag
from torchrl_tsallis.objectives.actor import own_parameters
from torchrl_tsallis.objectives.asking import AskedLoss
from torchrl_tsallis.objectives.inputs import check_actors, check_key
from torchrl_tsallis.objectives.passes import ActorPasses
from torchrl_tsallis.ratings.base import Evidence, Rated, Rating
from torchrl_tsallis.ratings.batch import Batch, rating_statistics
from torchrl_tsallis.ratings.tsallis import TsallisRating

_STATISTICS = ("rating_mean", "rating_var", "ess", "log_prob")


class TsallisBCLoss(ActorPasses, AskedLoss, LossModule):
    r"""Noise-robust behavioral cloning: every sample counts by its rating (eq. 10).

    .. math::
        L(\theta) = -\mathbb{E}\left[\pi_\gamma^{q-1} \ln_q \pi(a|s;\theta)\right], \qquad
        \nabla_\theta L = -\mathbb{E}\left[\rho \, \nabla_\theta \ln \pi\right], \quad
        \rho = (\pi / \pi_\gamma)^{1-q}

    ``rating`` says what rho is; q and gamma are the paper's, whose methods are settings of the short form:

    ==============================  ================================================================
    plain BC (eq. 1)                ``q=1.0, gamma_mix=0.0``
    q-BC, absolute rating (eq. 6)   ``q=0.8, gamma_mix=0.0``
    q-KL, relative rating (eq. 8)   ``q=0.8, gamma_mix=1.0``
    adaptive gamma, fixed q         ``q=0.8``
    proposal                        ``q=0.8`` and a :class:`~torchrl_tsallis.QTuner`
    gamma = 0, tuned q              ``gamma_mix=0.0`` and a :class:`~torchrl_tsallis.QTuner`
    rating without units            ``rating=PeakRating()`` and a :class:`~torchrl_tsallis.ScoreTuner`
    ==============================  ================================================================

    Reads the observation keys of the actor and ``action`` (``[*B, A]``). A recurrent actor takes sequences
    ``[*B, T]``, of which every step is rated; its state, which it writes under ``next``, is read where it is given and
    zero where it is not. Writes the keys below; all but the loss are
    detached scalars, or ``[S]``.

    ====================  =====================================================================
    ``loss_tsallis_bc``   the loss, a scalar, or ``[*B]`` with ``reduction="none"``
    what the rating logs  ``q``, ``gamma_mix`` and ``bound``; or ``u`` and ``distance``
    ``rating_mean``       mean of the rating
    ``rating_var``        (biased) variance of the rating
    ``ess``               effective sample size of the batch under the rating, in samples
    ``log_prob``          mean log-density of the batch
    ``member_loss``       only with stacked members: the loss of each, ``[S]``
    ====================  =====================================================================

    **Stacked members.** A list of S actors trains all of them as one program: parameters ``[S, ...]``, batches
    ``[S, *B]``, and with sequences for the rating's settings each member by its own method. The loss is the sum of
    the members' means, so that each has the gradient that it would have alone; every other output is ``[S]``. The
    optimizer has to keep members apart, as ``AdaTerm(loss.parameters(), batch_dims=1)`` does.

    **Data-parallel training.** Where ``torch.distributed`` is initialised, every statistic of the batch is that of all
    processes' samples, and so is the tuner's. With
    ``reduction="mean"`` the loss is scaled so that the average of the processes' gradients, as
    ``DistributedDataParallel`` takes it, is the gradient of the mean over all samples, also where their numbers differ
    by a mask. Every process has to call ``forward`` then; :meth:`rating` does not communicate.

    The target network exists only if the rating needs it. With a target network, a target updater such as
    :class:`~torchrl_tsallis.CATSoftUpdate` has to follow the policy.

    Source: Kobayashi & Aoyama, "Adaptive Absolute-Relative Rating for Noise Rejection in Behavioral Cloning based on
    Tsallis Statistics", SII 2025.

    Args:
        actor_network: stochastic actor; any whose ``get_dist`` gives a distribution with ``log_prob``. A list of them,
            alike but for their parameters, are stacked members.

    Keyword Args:
        rating (Rating): what weighs the samples, for this loss alone. Default: None, a
            :class:`~torchrl_tsallis.TsallisRating` of the settings below.
        q, gamma_mix, gamma_min, gamma_max, beta: short form of :class:`~torchrl_tsallis.TsallisRating`, with its
            defaults.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.
        sync_stats (bool): take the statistics of the batch over all processes of ``torch.distributed``, where it is
            initialised. Default: True.
        process_group (ProcessGroup): these processes only. Default: None, all of them.

    Raises:
        TypeError: for an actor that is none, and in ``forward`` for data of another type than the actor's parameters.
        ValueError: for a setting outside of its range, and in ``forward`` for shapes that do not fit.
        KeyError: in ``forward``, for a missing key.

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

    out_keys = ["loss_tsallis_bc", *TsallisRating.logged, *_STATISTICS]

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | Sequence[ProbabilisticTensorDictSequential],
        *,
        rating: Rating | None = None,
        reduction: Literal["mean", "sum", "none"] | None = None,
        sync_stats: bool = True,
        process_group: Any = None,
        **tsallis: Any,
    ) -> None:
        super().__init__()
        members = check_actors(actor_network)
        self.num_members = None if members is None else len(members)
        if reduction is not None:
            check_choice("reduction", reduction, ("mean", "sum", "none"))
        if rating is not None and tsallis:
            raise ValueError(
                f"{', '.join(tsallis)} are settings of TsallisRating: give them to the rating, or no rating"
            )
        if not isinstance(rating, Rating | None):
            raise TypeError(f"rating must be a Rating such as PeakRating(), got {rating!r}")
        rating = TsallisRating(**tsallis) if rating is None else rating
        rating.stack(self.num_members)
        self.needs_target = rating.needs_target
        self.convert_to_functional(
            members or actor_network,
            "actor_network",
            expand_dim=self.num_members,
            create_target_params=self.needs_target,
        )
        if self.num_members == 1:  # TorchRL has expanded the parameters of a single module: they are leaves no more
            self.actor_network_params = own_parameters(self.actor_network_params)
        self.rating_module = rating
        self._in_keys: list[NestedKey] | None = None
        self.reduction = reduction or "mean"
        self.sync_stats = check_flag("sync_stats", sync_stats)
        self.process_group = process_group
        member_loss = ["member_loss"] if members and self.reduction != "none" else []
        self.out_keys = ["loss_tsallis_bc", *rating.logged, *_STATISTICS, *member_loss]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Behavioral cloning has no value estimator to forward the keys to."""

    def _make_vmap(self) -> None:
        """``torch.vmap`` is made where it is called, with the randomness that is set then."""

    def train(self, mode: bool = True) -> TsallisBCLoss:
        """Sets the actor's mode too, which decides about dropout and noise; TorchRL keeps it out of its children."""
        super().train(mode)
        if "actor_network" in self.__dict__:
            self.actor_network.train(mode)
        return self

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets the tensordict keys; see :class:`_AcceptedKeys`."""
        for name, key in kwargs.items():
            check_key(name, key)
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

    def batch_of(self, mask: Tensor | None, sync: bool = True) -> Batch:
        """What a mean over a batch with a mask ``[*B]`` means: of its members, and of all processes if ``sync``."""
        return Batch.of(mask, self.num_members is not None, sync and self.sync_stats, self.process_group)

    def _rate(self, tensordict: TensorDictBase, sync: bool = True) -> tuple[Evidence, Rated]:
        """Rates a batch."""
        evidence = self._evidence(tensordict, sync)
        return evidence, self.rating_module(evidence)

    def _more(self, evidence: Evidence, rated: Rated, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Further losses of a variant, by their keys."""
        return {}

    def _reduced(self, losses: Tensor, batch: Batch) -> Tensor:
        """Losses ``[*B]`` by the reduction that is set, a scalar, or ``[S]`` with members."""
        if self.reduction == "none":
            return losses if batch.mask is None else losses.where(batch.mask, 0.0)
        return batch.share_of_mean(losses) if self.reduction == "mean" else batch.sum(losses)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss and its statistics.

        Args:
            tensordict: demonstrations with the keys of ``in_keys``, ``[*B]``; a mask under ``loss_mask_key`` selects.

        Returns:
            A tensordict with the keys of ``out_keys``.
        """
        evidence, rated = self._rate(tensordict)
        loss = self._reduced(rated.loss, evidence.batch)
        # Of members the sum, so that each gets the gradient that it would have by itself.
        summed = self.num_members is not None and self.reduction != "none"
        out = {"loss_tsallis_bc": loss.sum(), "member_loss": loss.detach()} if summed else {"loss_tsallis_bc": loss}
        out |= self._more(evidence, rated, tensordict)
        self.remember(rated.evidence, evidence.batch)
        with torch.no_grad():
            out |= rated.logged | rating_statistics(rated.weight, evidence.batch)
            (out["log_prob"],) = evidence.batch.mean(evidence.log_prob.detach())
        td_out = TensorDict(out, [])
        self._clear_weakrefs(tensordict, td_out, "actor_network_params", "target_actor_network_params")
        return td_out
