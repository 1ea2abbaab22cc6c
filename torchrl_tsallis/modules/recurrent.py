"""The recurrent policy of section VI, as a factory of a TorchRL actor, and its LSTM with a noisy internal state."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import _VF, Tensor, nn
from torch.nn.utils.rnn import PackedSequence
from torchrl.modules import IndependentNormal, LSTMModule, ProbabilisticActor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis.modules.policy import NormalHead
from torchrl_tsallis.modules.settings import check_dims, check_key, memory_for

State = tuple[Tensor, Tensor]
#: Layers that are made one by one, so that a slip of the pen would be waited for without end.
MOST_LAYERS = 1000


class NoisyLSTM(nn.LSTM):
    r"""``torch.nn.LSTM`` whose hidden state is disturbed by white noise during training.

    .. math:: h_t = \mathrm{LSTM}(x_t, h_{t-1}, c_{t-1}) + \epsilon_t, \qquad \epsilon_t \sim N(0, \sigma^2)

    for each layer: what a layer remembers, what it hands to the next layer, and the state that it returns are the same
    disturbed :math:`h_t`. The noise comes from torch's global generator. In evaluation, or with ``state_noise=0``, it
    is ``torch.nn.LSTM`` itself.

    Torch's fused kernel lets nobody into its loop, so the noise enters as a further input: the gates take
    :math:`W_{hh} (h_{t-1} + \epsilon_{t-1})` as :math:`[W_{ih}, W_{hh}] [x_t; \epsilon_{t-1}] + W_{hh} h_{t-1}`. That
    is exact, and several times faster than a loop over time in Python.

    Args:
        input_size: dimension I of the input ``[B, T, I]``.
        hidden_size: dimension H of the state.
        num_layers: number L of layers.
        state_noise: scale of the noise (1e-3, section VI-A).

    Raises:
        TypeError: for an argument that is no number, or a dimension that is no integer.
        ValueError: if a dimension is not positive, or the scale is negative or not finite.

    Examples:
        >>> output, (h, c) = NoisyLSTM(3, 5, 2)(torch.zeros(4, 7, 3))
        >>> output.shape, h.shape
        (torch.Size([4, 7, 5]), torch.Size([2, 4, 5]))
    """

    def __init__(self, input_size: int, hidden_size: int, num_layers: int = 1, *, state_noise: float = 1e-3) -> None:
        check_dims(input_size=input_size, hidden_size=hidden_size, num_layers=num_layers)
        state_noise = check_number("state_noise", state_noise, low=0)
        check_number("num_layers", num_layers, high=MOST_LAYERS, integer=True)
        with memory_for(input_size=input_size, hidden_size=hidden_size, num_layers=num_layers):
            super().__init__(int(input_size), int(hidden_size), int(num_layers), batch_first=True)
        self.state_noise = state_noise

    def forward(  # type: ignore[override]
        self, input: Tensor | PackedSequence, hx: State | None = None
    ) -> tuple[Tensor | PackedSequence, State]:
        """Runs the sequences; as ``torch.nn.LSTM``'s, batch first."""
        if not (self.training and self.state_noise > 0):
            return super().forward(input, hx)
        if isinstance(input, PackedSequence):
            return self._forward_packed(input, hx)
        h, c = self._initial(input, input.shape[0]) if hx is None else hx
        states = []
        for layer in range(self.num_layers):
            noise = self.state_noise * torch.randn(*input.shape[:2], self.hidden_size).to(input)
            before = torch.cat([torch.zeros_like(noise[:, :1]), noise[:, :-1]], 1)
            state = (h[layer : layer + 1].contiguous(), c[layer : layer + 1].contiguous())
            output, h_n, c_n = _VF.lstm(
                torch.cat([input, before], -1), state, self._weights(layer), True, 1, 0.0, True, False, True
            )
            input = output + noise
            states.append((h_n + noise[None, :, -1], c_n))
        return input, self._stack(states)

    def _forward_packed(self, packed: PackedSequence, hx: State | None) -> tuple[PackedSequence, State]:
        """The same for sequences of several lengths: row i of step t lies at ``begin[t] + i``, longest first."""
        data, sizes = packed.data, packed.batch_sizes
        h, c = self.permute_hidden(self._initial(data, int(sizes[0])) if hx is None else hx, packed.sorted_indices)
        begin = sizes.cumsum(0) - sizes
        rows = torch.cat([torch.arange(int(size)) for size in sizes])
        steps = torch.arange(len(sizes)).repeat_interleave(sizes)
        earlier = (begin[(steps - 1).clamp_min(0)] + rows).to(data.device)
        lengths = (sizes[:, None] > torch.arange(int(sizes[0]))).sum(0)
        last = (begin[lengths - 1] + torch.arange(int(sizes[0]))).to(data.device)
        first = (steps == 0).unsqueeze(-1).to(data.device)
        states = []
        for layer in range(self.num_layers):
            noise = self.state_noise * torch.randn(len(data), self.hidden_size).to(data)
            state = (h[layer : layer + 1].contiguous(), c[layer : layer + 1].contiguous())
            given = torch.cat([data, noise[earlier].masked_fill(first, 0.0)], -1)
            output, h_n, c_n = _VF.lstm(given, sizes, state, self._weights(layer), True, 1, 0.0, True, False)
            data = output + noise
            states.append((h_n + noise[last], c_n))
        out = PackedSequence(data, sizes, packed.sorted_indices, packed.unsorted_indices)
        return out, self.permute_hidden(self._stack(states), packed.unsorted_indices)

    def _initial(self, like: Tensor, rows: int) -> State:
        zeros = like.new_zeros(self.num_layers, rows, self.hidden_size)
        return zeros, zeros

    def _weights(self, layer: int) -> list[Tensor]:
        """A layer's weights, with those of the noise beside those of its input."""
        w_ih, w_hh, b_ih, b_hh = (getattr(self, name) for name in self._all_weights[layer])
        return [torch.cat([w_ih, w_hh], 1), w_hh, b_ih, b_hh]

    @staticmethod
    def _stack(states: list[State]) -> State:
        h, c = zip(*states, strict=True)
        return torch.cat(h), torch.cat(c)


def make_recurrent_policy(
    obs_dim: int,
    action_dim: int,
    *,
    hidden_size: int = 100,
    num_layers: int = 2,
    state_noise: float = 1e-3,
    min_scale: float = 0.0,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    prediction_key: NestedKey | None = "predicted_observation",
) -> ProbabilisticActor:
    """Builds the imitator of section VI-A: LSTM layers, a diagonal normal of the action, and the next observation.

    The two LSTM layers stand where the hidden layers of :func:`~torchrl_tsallis.modules.make_policy` were; each head
    is one linear layer on the last one. The next observation is predicted as a point: the density of a fitted normal
    would grow without bound along the nearly deterministic parts of the dynamics, and drown the policy's loss.

    The network expects standardised observations and gives actions in the unit of the data, see
    :class:`~torchrl_tsallis.data.Scaling`.

    Under :func:`torchrl.modules.set_recurrent_mode`, as in TorchRL's losses, it takes sequences ``[*B, T]``; an
    ``is_init`` within one starts from the stored state, or zeros where none is stored. Otherwise it takes one step,
    ``[*B]``, and carries the state from ``recurrent_state_h`` and ``recurrent_state_c`` to the same keys under
    ``next``, ``[*B, num_layers, hidden_size]``; ``is_init`` resets it.

    Args:
        obs_dim: dimension of the observation.
        action_dim: dimension A of the action. The density is over the raw action; limit the mean when it is executed.
        hidden_size: units a layer (100, section VI-A).
        num_layers: LSTM layers (2, section VI-A).
        state_noise: scale of the white noise on the hidden state during training (1e-3, section VI-A).
        min_scale: added to the scale of the action; 0 as in the paper.
        observation_key: key of the observation, ``[*B, T, obs_dim]``.
        action_key: key of the action, ``[*B, T, A]``.
        prediction_key: key of the predicted next observation, ``[*B, T, obs_dim]``; None leaves that head out.

    Returns:
        An actor that writes ``loc``, ``scale``, the prediction, the recurrent state and the action.

    Raises:
        TypeError: for a dimension that is no integer, a number that is none, or a key that is none.
        ValueError: if a dimension is not positive, a noise or scale negative or not finite, or a key empty.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> data = TensorDict({"observation": torch.zeros(2, 7, 12)}, [2, 7])
        >>> data["is_init"] = torch.zeros(2, 7, 1, dtype=torch.bool)
        >>> with set_recurrent_mode(True):
        ...     out = make_recurrent_policy(12, 3)(data)
        >>> out["action"].shape, out["predicted_observation"].shape
        (torch.Size([2, 7, 3]), torch.Size([2, 7, 12]))
    """
    check_dims(obs_dim=obs_dim, action_dim=action_dim, hidden_size=hidden_size, num_layers=num_layers)
    check_key("observation_key", observation_key)
    check_key("action_key", action_key)
    if prediction_key is not None:
        check_key("prediction_key", prediction_key)
    check_number("num_layers", num_layers, high=MOST_LAYERS, integer=True)
    obs_dim, action_dim, hidden_size = int(obs_dim), int(action_dim), int(hidden_size)
    with memory_for(obs_dim=obs_dim, hidden_size=hidden_size, action_dim=action_dim):
        lstm = LSTMModule(
            lstm=NoisyLSTM(obs_dim, hidden_size, num_layers, state_noise=state_noise),
            in_key=observation_key,
            out_key="features",
        )
        head = nn.Sequential(nn.Linear(hidden_size, 2 * action_dim), NormalHead(min_scale))
    parts = [lstm, TensorDictModule(head, in_keys=["features"], out_keys=["loc", "scale"])]
    if prediction_key is not None:
        predictor = nn.Linear(hidden_size, obs_dim)
        parts.append(TensorDictModule(predictor, in_keys=["features"], out_keys=[prediction_key]))
    return ProbabilisticActor(
        TensorDictSequential(*parts),
        in_keys=["loc", "scale"],
        out_keys=[action_key],
        distribution_class=IndependentNormal,
    )
