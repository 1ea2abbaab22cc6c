"""Behavioral cloning that learns to predict the next observation along with the policy (section VI)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey, expand_right, unravel_key
from torch import Tensor
from torch.distributions import Distribution

from torchrl_tsallis._checks import check_flag, check_number
from torchrl_tsallis.objectives.actor import named_inputs
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.ratings.base import Evidence, Rated


class PredictiveBCLoss(TsallisBCLoss):
    r""":class:`~torchrl_tsallis.TsallisBCLoss` plus the error of the actor's prediction of the next observation.

    .. math::
        L(\theta) = L_{q,\gamma}(\theta) + \beta \, \mathbb{E}\left[
        \frac{1}{O} \lVert \hat{o}_{t+1}(\theta) - o_{t+1} \rVert^2 \right]

    A recurrent state that predicts what comes next holds what the policy has to know of the past. The second term is
    not rated by default: what follows an operator's fault is physics as well. ``rate_prediction`` weighs it by the
    samples' ratings too. Both come from one pass of the network.

    Reads what :class:`~torchrl_tsallis.TsallisBCLoss` does, and the next observation, ``[*B, O]``. Writes its keys and

    ====================  =====================================================================
    ``loss_prediction``   beta times the squared error, a scalar, or ``[*B]`` with ``reduction="none"``
    ====================  =====================================================================

    which steppers that sum every ``loss_`` key add by themselves. Observations should be standardised, because the
    error weighs all of their dimensions alike.

    Args:
        actor_network: stochastic actor that writes the prediction, as
            :func:`~torchrl_tsallis.modules.make_recurrent_policy` makes it.

    Keyword Args:
        prediction_weight (float): beta, not negative. Default: 1.0.
        rate_prediction (bool): whether a sample's prediction error counts by its rating too. Default: False.
        **settings: as for :class:`~torchrl_tsallis.TsallisBCLoss`.

    Raises:
        ValueError: for a negative weight, an actor that writes no prediction, or stacked members.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_tsallis.modules import make_recurrent_policy
        >>> loss = PredictiveBCLoss(make_recurrent_policy(3, 2), gamma_mix=0.0)
        >>> data = TensorDict({"observation": torch.zeros(4, 5, 3), "action": torch.zeros(4, 5, 2)}, [4, 5])
        >>> data["is_init"] = torch.zeros(4, 5, 1, dtype=torch.bool)
        >>> data["next", "observation"] = torch.zeros(4, 5, 3)
        >>> sorted(key for key in loss(data).keys() if key.startswith("loss_"))
        ['loss_prediction', 'loss_tsallis_bc']
    """

    @dataclass
    class _AcceptedKeys(TsallisBCLoss._AcceptedKeys):
        """Configurable keys.

        Attributes:
            action: the demonstrated action. Default: ``"action"``.
            next_observation: what is predicted. Default: ``("next", "observation")``.
            prediction: what the actor writes. Default: ``"predicted_observation"``.
        """

        next_observation: NestedKey = ("next", "observation")
        prediction: NestedKey = "predicted_observation"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        prediction_weight: float = 1.0,
        rate_prediction: bool = False,
        **settings: Any,
    ) -> None:
        prediction_weight = check_number("prediction_weight", prediction_weight, low=0)
        check_flag("rate_prediction", rate_prediction)
        super().__init__(actor_network, **settings)
        if self.num_members is not None:
            raise ValueError("PredictiveBCLoss has one policy: torch.vmap cannot stack LSTM layers")
        self.prediction_weight = prediction_weight
        self.rate_prediction = rate_prediction
        self.out_keys = [*self.out_keys, "loss_prediction"]
        self._check_prediction()

    def _check_prediction(self) -> None:
        key = unravel_key(self.tensor_keys.prediction)
        if key not in self.actor_network.out_keys:
            raise ValueError(
                f"the actor writes {list(map(str, self.actor_network.out_keys))}, no prediction {key!r}: give it that "
                "head, or use TsallisBCLoss"
            )

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets the tensordict keys; see :class:`_AcceptedKeys`."""
        super().set_keys(**kwargs)
        if "prediction" in kwargs:
            self._check_prediction()

    @property
    def in_keys(self) -> list[NestedKey]:
        """The action's key, the actor's input keys and the next observation's, in ``dispatch``'s order."""
        if self._in_keys is None:
            following = unravel_key(self.tensor_keys.next_observation)
            self._in_keys = [unravel_key(self.tensor_keys.action), *self.actor_network.in_keys, following]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _pass(self, inputs: TensorDictBase, params: TensorDictParams) -> tuple[Distribution, Tensor]:
        """As in the parent, and the prediction of the same pass."""
        written = inputs.copy()
        with (
            params.to_module(self.actor_network, preserve_module_state=False),
            named_inputs(self.actor_network, inputs),
        ):
            dist = self.actor_network.get_dist(written)
        return dist, written.get(self.tensor_keys.prediction)

    def _more(self, evidence: Evidence, rated: Rated, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The prediction's loss."""
        following, prediction, mask = (
            tensordict.get(self.tensor_keys.next_observation),
            evidence.written,
            evidence.batch.mask,
        )
        if prediction.shape != following.shape:
            raise ValueError(
                f"the prediction has shape {list(prediction.shape)}, the next observation {list(following.shape)}: "
                "the actor's obs_dim has to be that of the data"
            )
        if mask is not None:  # before the square, whose gradient a NaN in the padding would reach
            following = following.where(expand_right(mask, following.shape), torch.zeros_like(following))
        error = (prediction - following).square().mean(-1)
        if self.rate_prediction:
            error = error * rated.weight
        return {"loss_prediction": self.prediction_weight * self._reduced(error, evidence.batch)}
