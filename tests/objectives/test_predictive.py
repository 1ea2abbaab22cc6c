"""Contract of the loss on sequences: every step rated, masks, the prediction, and no leak."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import SoftUpdate

from torchrl_tsallis import PredictiveBCLoss, TsallisBCLoss
from torchrl_tsallis.modules import make_policy, make_recurrent_policy


def batch(rows: int = 3, steps: int = 6) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(rows, steps, 4, generator=generator)
    is_init = torch.zeros(rows, steps, 1, dtype=torch.bool)
    is_init[:, 0] = True
    data = {"observation": observation, "action": observation[..., :2].tanh(), "is_init": is_init}
    data["next"] = TensorDict({"observation": observation.roll(-1, 1)}, [rows, steps])
    return TensorDict(data, [rows, steps])


def make_loss(kind=PredictiveBCLoss, **kwargs):
    torch.manual_seed(0)
    loss = kind(make_recurrent_policy(4, 2, hidden_size=5, state_noise=kwargs.pop("state_noise", 0.0)), **kwargs)
    if loss.needs_target:
        SoftUpdate(loss, tau=0.1)
        with torch.no_grad():
            for value in loss.target_actor_network_params.values(True, True):
                value.mul_(0.9)
    return loss


def total(out: TensorDict) -> torch.Tensor:
    return sum(value.sum() for key, value in out.items() if key.startswith("loss_"))


def grads(loss, data) -> list[torch.Tensor]:
    return list(torch.autograd.grad(total(loss(data)), list(loss.parameters())))


def test_both_losses_by_the_equations_with_a_recurrent_target():
    loss, data = make_loss(q=0.8, gamma_mix=0.5, prediction_weight=0.7), batch()
    log_probs, predictions = [], []
    for params in (loss.actor_network_params, loss.target_actor_network_params):
        with params.to_module(loss.actor_network), set_recurrent_mode(True):
            written = data.clone()
            log_probs.append(loss.actor_network.get_dist(written).log_prob(data["action"]))
            predictions.append(written["predicted_observation"])
    reference = (0.5 + 0.5 * log_probs[1].exp()).log().detach()
    expected = -((-0.2 * reference).exp() * ((0.2 * log_probs[0]).exp() - 1) / 0.2)
    error = 0.7 * (predictions[0] - data["next", "observation"]).square().mean(-1)
    out = loss(data)
    assert set(out.keys()) == set(loss.out_keys)
    torch.testing.assert_close(out["loss_tsallis_bc"], expected.mean())
    torch.testing.assert_close(out["loss_prediction"], error.mean())
    want = torch.autograd.grad(expected.mean() + error.mean(), list(loss.parameters()))
    torch.testing.assert_close(grads(loss, data), list(want))
    weights = (0.2 * (log_probs[0] - reference)).exp().detach()
    assert weights.shape == (3, 6)
    torch.testing.assert_close(loss.rating(data), weights)


def test_the_policy_part_is_that_of_the_parent_and_the_input_stays():
    data = batch()
    before = data.clone()
    out, parent = make_loss()(data), make_loss(TsallisBCLoss)(data)
    for key in parent.keys():  # noqa: SIM118
        torch.testing.assert_close(out[key], parent[key])
    assert set(data.keys(True)) == set(before.keys(True)) and (data == before).all()


def test_masked_steps_count_for_nothing_and_may_be_nan():
    data, loss = batch(), make_loss()
    mask = torch.ones(3, 6, dtype=torch.bool)
    mask[1, 4:] = False
    padded = data.clone().set(("collector", "mask"), mask)
    for key in ("observation", "action", ("next", "observation")):
        padded[key][1, 4:] = math.nan
    none = make_loss(reduction="none")
    out = none(padded)
    assert out["loss_prediction"].shape == out["loss_tsallis_bc"].shape == (3, 6)
    assert (out["loss_prediction"][1, 4:] == 0).all()
    torch.testing.assert_close(loss(padded)["loss_prediction"], none(data)["loss_prediction"][mask].mean())
    assert loss.last_evidence[1].mask.sum() == 16
    assert all(g.isfinite().all() for g in grads(loss, padded))
    short = [make_loss(gamma_mix=0.5, reduction="none")(part) for part in (data[1:2, :4], padded)]
    torch.testing.assert_close(short[0]["loss_tsallis_bc"][0], short[1]["loss_tsallis_bc"][1, :4])


def test_no_trajectory_changes_another():
    loss, data = make_loss(gamma_mix=0.5, reduction="none"), batch()
    before = loss(data)
    order = torch.tensor([2, 0, 1])
    permuted = loss(data[order])
    changed = data.clone()
    changed["observation"][1] += 3.0
    after = loss(changed)
    for key in ("loss_tsallis_bc", "loss_prediction"):
        torch.testing.assert_close(permuted[key], before[key][order])
        torch.testing.assert_close(after[key][[0, 2]], before[key][[0, 2]])
    # Trajectories in one row, split by is_init, are those in rows of their own.
    row = data[:2].reshape(1, 12)
    torch.testing.assert_close(loss(row)["loss_tsallis_bc"].reshape(2, 6), before["loss_tsallis_bc"][:2])


def test_noise_is_off_in_evaluation():
    loss, data = make_loss(state_noise=0.1, gamma_mix=0.5), batch()
    assert not torch.equal(loss(data)["loss_tsallis_bc"], loss(data)["loss_tsallis_bc"])
    torch.testing.assert_close(loss.rating(data), make_loss(gamma_mix=0.5).rating(data))
    assert loss.training and loss.actor_network.training, "rating leaves the mode as it was"
    loss.eval()
    torch.testing.assert_close(loss(data), make_loss(gamma_mix=0.5).eval()(data))
    assert loss.train().actor_network.training


@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_the_prediction_is_rated_on_request(reduction):
    data = batch()
    data["action"][0] += 3.0
    plain, rated = (make_loss(gamma_mix=0.0, reduction="none", rate_prediction=rate)(data) for rate in (False, True))
    weight = make_loss(gamma_mix=0.0).rating(data)
    assert weight.min() < 0.9 * weight.max()
    expected = plain["loss_prediction"] * weight
    got = make_loss(gamma_mix=0.0, reduction=reduction, rate_prediction=True)(data)["loss_prediction"]
    torch.testing.assert_close(rated["loss_prediction"], expected)
    torch.testing.assert_close(got, expected if reduction == "none" else expected.mean())


def test_dispatch_and_other_keys():
    loss, data = make_loss(gamma_mix=0.0), batch()
    assert loss.in_keys[0] == "action" and loss.in_keys[-1] == ("next", "observation")
    torch.manual_seed(0)
    actor = make_recurrent_policy(4, 2, hidden_size=5, state_noise=0.0, prediction_key="seen")
    with pytest.raises(ValueError, match="no prediction"):
        PredictiveBCLoss(actor)
    with pytest.raises(ValueError, match="no prediction"):
        loss.set_keys(prediction="seen")
    loss.set_keys(prediction=None, next_observation="after")
    moved = data.clone().set("after", data["next", "observation"]).exclude("next")
    torch.testing.assert_close(loss(moved), make_loss(gamma_mix=0.0)(data))


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="no prediction 'predicted_observation'"):
        PredictiveBCLoss(make_policy(4, 2))
    with pytest.raises(ValueError, match="prediction_weight"):
        make_loss(prediction_weight=-1.0)
    with pytest.raises(KeyError, match="is_init"):
        make_loss()(batch().exclude("is_init"))
    with pytest.raises(KeyError, match="next"):
        make_loss()(batch().exclude("next"))
