"""The recurrent policy: its noise, its state, and what must not leak."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence
from torchrl.modules import set_recurrent_mode

from torchrl_tsallis.modules import NoisyLSTM, make_recurrent_policy


def sequences(rows: int = 3, steps: int = 6, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(rows, steps, 4, generator=generator)
    is_init = torch.zeros(rows, steps, 1, dtype=torch.bool)
    is_init[:, 0] = True
    return TensorDict({"observation": observation, "is_init": is_init}, [rows, steps])


def make(seed: int = 0, **kwargs):
    torch.manual_seed(seed)
    return make_recurrent_policy(4, 2, hidden_size=5, **kwargs)


def run(actor, data: TensorDict) -> TensorDict:
    with torch.no_grad(), set_recurrent_mode(True):
        return actor(data.clone())


def test_structure_of_the_paper():
    actor = make_recurrent_policy(12, 3)
    lstm = next(m for m in actor.modules() if isinstance(m, NoisyLSTM))
    assert (lstm.input_size, lstm.hidden_size, lstm.num_layers, lstm.state_noise) == (12, 100, 2, 1e-3)
    assert {"loc", "scale", "predicted_observation", "action"} <= set(actor.out_keys)
    assert "predicted_observation" not in make_recurrent_policy(12, 3, prediction_key=None).out_keys


def noisy_by_hand(lstm: NoisyLSTM, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The definition, step by step, with the noise in the order in which it is drawn."""
    last_h, last_c = [], []
    drawn = [torch.randn(*x.shape[:2], lstm.hidden_size) for _ in range(lstm.num_layers)]
    for layer in range(lstm.num_layers):
        noise = lstm.state_noise * drawn[layer]
        w, u, b, c = (getattr(lstm, name) for name in lstm._all_weights[layer])
        cell = torch.nn.LSTMCell(w.shape[1], lstm.hidden_size)
        cell.load_state_dict({"weight_ih": w, "weight_hh": u, "bias_ih": b, "bias_hh": c})
        state, out = None, []
        for t in range(x.shape[1]):
            h, memory = cell(x[:, t], state)
            state = (h + noise[:, t], memory)
            out.append(state[0])
        x = torch.stack(out, 1)
        last_h.append(state[0])
        last_c.append(state[1])
    return x, torch.stack(last_h), torch.stack(last_c)


def test_the_noise_is_on_the_state_at_every_step():
    torch.manual_seed(0)
    lstm, x = NoisyLSTM(4, 5, 2, state_noise=0.3), torch.randn(3, 6, 4)
    torch.manual_seed(1)
    output, (h, c) = lstm(x)
    torch.manual_seed(1)
    expected = noisy_by_hand(lstm, x)
    torch.testing.assert_close((output, h, c), expected)
    assert ((lstm.eval()(x)[0] - output).abs() > 0.05).any()


def test_packed_sequences_have_the_same_noise_model():
    torch.manual_seed(0)
    lstm, x, lengths = NoisyLSTM(4, 5, 2, state_noise=0.3), torch.randn(4, 6, 4), torch.tensor([2, 6, 1, 4])
    packed = pack_padded_sequence(x, lengths, batch_first=True, enforce_sorted=False)
    sizes, order = packed.batch_sizes, packed.sorted_indices
    torch.manual_seed(1)
    out, (h, c) = lstm(packed)
    out, _ = pad_packed_sequence(out, batch_first=True)
    torch.manual_seed(1)
    drawn = [torch.randn(int(sizes.sum()), 5) for _ in range(2)]
    begin = sizes.cumsum(0) - sizes
    for place, row in enumerate(order.tolist()):
        own = [noise[begin[: lengths[row]] + place] for noise in drawn]  # [length, H] a layer
        values = iter(noise[None] for noise in own)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "randn", lambda *_, source=values: next(source))
            expected, h_row, c_row = noisy_by_hand(lstm, x[row : row + 1, : lengths[row]])
        torch.testing.assert_close(out[row, : lengths[row]], expected[0])
        torch.testing.assert_close((h[:, row], c[:, row]), (h_row[:, 0], c_row[:, 0]))


def test_noise_is_for_training_alone_and_reproducible():
    actor, data = make(), sequences()
    results = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        results.append(run(actor, data)["loc"])
    assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])
    assert (results[0] - results[2]).abs().max() < 0.1
    actor.eval()
    assert torch.equal(run(actor, data)["loc"], run(actor, data)["loc"])
    silent = make(state_noise=0.0)
    torch.testing.assert_close(run(silent, data)["loc"], run(actor, data)["loc"])


def test_step_by_step_equals_the_sequence_and_is_init_resets():
    actor, data = make().eval(), sequences()
    data["is_init"][1, 3] = True  # a new trajectory within the row
    whole = run(actor, data)
    step = data[:, 0].clone()
    for t in range(data.shape[1]):
        step["observation"], step["is_init"] = data["observation"][:, t], data["is_init"][:, t]
        with torch.no_grad():
            actor(step)
        torch.testing.assert_close(step["loc"], whole["loc"][:, t])
        torch.testing.assert_close(step["predicted_observation"], whole["predicted_observation"][:, t])
        for name in ("recurrent_state_h", "recurrent_state_c"):
            step[name] = step["next", name]


def test_no_trajectory_sees_another():
    actor, data = make().eval(), sequences()
    data["is_init"][0, 2] = True
    before = run(actor, data)["loc"]
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(run(actor, data[order])["loc"], before[order])
    changed = data.clone()
    changed["observation"][0, :2] += 5.0  # the trajectory before, in the same row
    changed["observation"][1] += 5.0  # another row
    after = run(actor, changed)["loc"]
    torch.testing.assert_close(after[0, 2:], before[0, 2:])
    torch.testing.assert_close(after[2], before[2])
    assert ((after[1] - before[1]).abs() > 1e-3).any()


def test_a_slice_from_the_start_or_with_its_state_equals_the_whole():
    actor, data = make().eval(), sequences(steps=8)
    whole = run(actor, data)["loc"]
    first = run(actor, data[:, :5])
    torch.testing.assert_close(first["loc"], whole[:, :5])
    second = data[:, 5:].clone()
    zeros = run(actor, second)["loc"]
    for name in ("recurrent_state_h", "recurrent_state_c"):
        state = torch.zeros(3, 3, 2, 5)
        state[:, 0] = first["next", name][:, -1]  # the state before the slice, at its first step
        second[name] = state
    torch.testing.assert_close(run(actor, second)["loc"], whole[:, 5:])
    assert ((zeros - whole[:, 5:]).abs() > 1e-4).any()


def test_refuses_bad_settings():
    with pytest.raises(ValueError, match="obs_dim=0"):
        make_recurrent_policy(0, 3)
    with pytest.raises(ValueError, match="state_noise"):
        make_recurrent_policy(4, 3, state_noise=-1.0)
