"""The passes of the networks that a loss needs: the policy's, and its target's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution

from torchrl_tsallis.objectives.actor import get_dist_with, get_stacked_dist
from torchrl_tsallis.objectives.inputs import mask_of, select_inputs
from torchrl_tsallis.objectives.log_prob import log_prob_of
from torchrl_tsallis.ratings.base import Evidence, Rating
from torchrl_tsallis.ratings.batch import Batch


class ActorPasses:
    """Mixin of :class:`~torchrl_tsallis.TsallisBCLoss`: what its rating is given of a batch."""

    rating_module: Rating
    num_members: int | None
    needs_target: bool

    if TYPE_CHECKING:
        actor_network: Any
        actor_network_params: Any
        target_actor_network_params: Any
        target_members: Tensor | None
        tensor_keys: Any
        vmap_randomness: str
        in_keys: list[NestedKey]

        def batch_of(self, mask: Tensor | None, sync: bool = True) -> Batch:  # noqa: D102
            ...

    def _pass(self, inputs: TensorDictBase, params: TensorDictBase) -> tuple[Distribution, Any]:
        """The distribution, and what else a variant of the loss needs of the same pass of the network."""
        if self.num_members is not None:
            return get_stacked_dist(self.actor_network, inputs, params, self.vmap_randomness), None
        return get_dist_with(self.actor_network, inputs, params), None

    @torch.no_grad()
    def _target_log_prob(self, inputs: TensorDictBase) -> Tensor | None:
        """The target network's log-density; 0 for members that are not rated by it, whose pass is saved."""
        if not self.needs_target:
            return None
        params, key = self.target_actor_network_params, self.tensor_keys.action
        if self.target_members is None:
            return log_prob_of(self._pass(inputs, params)[0], inputs, key)
        index = self.target_members.nonzero()[:, 0]
        some = inputs[index]
        log_prob = log_prob_of(self._pass(some, params.data[index])[0], some, key)
        return log_prob.new_zeros(inputs.shape).index_copy(0, index.to(log_prob.device), log_prob)

    def _evidence(self, tensordict: TensorDictBase, sync: bool) -> Evidence:
        """What the rating is given: one pass of the network, and one of the target's where the rating asks for it."""
        mask, key = mask_of(self, tensordict), self.tensor_keys.action
        batch = self.batch_of(mask, sync)
        dtype = next((p.dtype for p in self.actor_network_params.parameters() if p.is_floating_point()), None)
        inputs = select_inputs(
            tensordict, self.actor_network, self.in_keys, members=self.num_members, mask=mask, dtype=dtype
        )
        dist, written = self._pass(inputs, self.actor_network_params)
        action, log_prob = inputs.get(key), log_prob_of(dist, inputs, key)
        likelihood = self.rating_module.likelihood(log_prob, dist, action, batch)
        return Evidence(log_prob, likelihood, dist, action, self._target_log_prob(inputs), batch, written)
