"""Every rating that a recipe trains by is saved and opened again with what it has learnt."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import CATSoftUpdate, PeakRating, QTuner, TsallisBCLoss, TsallisRating
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.ratings import Rated, Rating
from torchrl_tsallis.runs import Run
from torchrl_tsallis.runs.saved import save_run

RATINGS = {
    "bc": lambda: TsallisRating(q=1.0, gamma_mix=0.0),
    "q_bc": lambda: TsallisRating(q=0.7, gamma_mix=0.0, beta=0.5),
    "q_kl": lambda: TsallisRating(q=0.8, gamma_mix=1.0),
    "proposal": lambda: TsallisRating(q=0.8, gamma_min=0.2),
    "peak": lambda: PeakRating(u=0.1),
}


def trained(rating, steps=20):
    """A loss after some steps, with a target network that lags behind where there is one."""
    torch.manual_seed(0)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(7,)), rating=rating)
    updater = CATSoftUpdate(loss, tau=0.1) if loss.needs_target else None
    tuner = QTuner(loss) if isinstance(rating, TsallisRating) and rating.q < 1 and rating.gamma_low < 1 else None
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(steps):
        x = torch.randn(64, 3)
        batch = TensorDict({"observation": x, "action": x[:, :2] + 0.1 * torch.randn(64, 2)}, [64])
        optimizer.zero_grad()
        loss(batch)["loss_tsallis_bc"].backward()
        optimizer.step()
        for after in (tuner, updater):
            if after is not None:
                after.step()
    return loss, batch


def save(folder, loss, **changes):
    actor = loss.actor_network_params.data.flatten_keys(".")
    target = loss.target_actor_network_params.data.flatten_keys(".") if loss.needs_target else None
    options = {
        "kind": "recipe",
        "actor": dict(actor.items()),
        "rating": loss.rating_module.state_dict(),
        "rating_class": type(loss.rating_module),
        "arguments": {"obs_dim": 3, "action_dim": 2, "hidden": [7]},
        "data": {"format": "memory", "keys": {"observation": ["observation"], "action": ["action"]}},
        "train": {"steps": 20},
        "command": "a test",
        "target": None if target is None else dict(target.items()),
    }
    save_run(folder, **options | changes)


@pytest.mark.parametrize("name", RATINGS)
def test_an_opened_run_rates_as_the_loss_did(tmp_path, name):
    loss, batch = trained(RATINGS[name]())
    save(tmp_path, loss)
    run = Run.open(tmp_path)
    torch.testing.assert_close(run.rate(batch), loss.rating(batch), rtol=0, atol=0)
    assert (run.rate(batch) == 1).all() == (name == "bc")
    assert (tmp_path / "target.safetensors").exists() == (name in ("q_kl", "proposal"))
    again, state = run.loss().rating_module.state_dict(), loss.rating_module.state_dict()
    assert again.keys() == state.keys() and all(torch.equal(again[key], state[key]) for key in state)
    mean = run.actor().get_dist(batch.select("observation")).mode
    torch.testing.assert_close(torch.from_numpy(run.numpy_policy()(batch["observation"].numpy())), mean.detach())


def test_a_target_network_that_is_missing_or_of_another_policy_is_said(tmp_path):
    loss, batch = trained(RATINGS["proposal"](), steps=1)
    save(tmp_path, loss)
    file = tmp_path / "target.safetensors"
    file.write_bytes((tmp_path / "rating.safetensors").read_bytes())
    with pytest.raises(ValueError, match="target.safetensors' is no state of the rating"):
        Run.open(tmp_path).rate(batch)
    file.unlink()
    with pytest.raises(FileNotFoundError, match="target.safetensors' is not there"):
        Run.open(tmp_path).rate(batch)


class Threshold(Rating):
    """Takes no sample whose density is under a limit: a rating of a user's own, in one file."""

    def __init__(self, limit=1.0, beta=0.0):
        super().__init__(beta)
        self.add_setting("limit", limit, 0, 10)

    def forward(self, evidence):
        value = -evidence.log_prob.detach()
        weight = (value < -self.limit.log()).to(value)
        return Rated(evidence.loss(value, weight), weight, value, {})


class Sealed(Threshold):
    """One that cannot be made again: its setting has another name than the argument."""

    def __init__(self, where):
        super().__init__(limit=where)


def test_a_rating_of_ones_own_is_saved_and_opened_without_a_word_elsewhere(tmp_path):
    loss, batch = trained(Threshold(limit=0.5))
    save(tmp_path, loss)
    run = Run.open(tmp_path)
    assert run.settings["method"] == {"rating": f"{__name__}.Threshold", "limit": 0.5, "beta": 0.0}
    assert isinstance(run.loss().rating_module, Threshold)
    torch.testing.assert_close(run.rate(batch), loss.rating(batch), rtol=0, atol=0)


def test_a_rating_that_could_not_be_opened_is_refused_before_anything_is_written(tmp_path):
    loss, _ = trained(Sealed(0.5), steps=1)
    with pytest.raises(
        ValueError, match="a Sealed cannot be made again from .*: give it settings_of and from_settings"
    ):
        save(tmp_path, loss)
    assert list(tmp_path.iterdir()) == []


def test_a_rating_whose_module_was_not_imported_is_named(tmp_path, monkeypatch):
    loss, batch = trained(Threshold(), steps=1)
    save(tmp_path, loss)
    monkeypatch.delitem(Rating.known, Threshold.saved_as)
    with pytest.raises(ValueError, match="Threshold' of run.json is not known here, only .*peak.*: import the module"):
        Run.open(tmp_path).rate(batch)


def test_two_ratings_of_one_name_do_not_meet():
    assert type("Threshold", (Threshold,), {"__module__": "elsewhere"}).saved_as == "elsewhere.Threshold"
    assert Rating.known[Threshold.saved_as] is Threshold
    with pytest.raises(TypeError, match="mine.Peak is saved as 'peak', as .*PeakRating is: rename it"):
        type("Peak", (Rating,), {"__module__": "mine", "saved_as": "peak"})
    assert Rating.known["peak"] is PeakRating
    again = type(Threshold.__qualname__, (Threshold,), {"__module__": Threshold.__module__})
    assert Rating.known[Threshold.saved_as] is again  # as in a notebook
    Rating.known[Threshold.saved_as] = Threshold
