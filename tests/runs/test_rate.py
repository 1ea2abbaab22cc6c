"""Demonstrations are rated from a file, and the folder opens again."""

from __future__ import annotations

import csv
import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from torchrl.record.loggers.csv import CSVLogger

from torchrl_tsallis.data import RobustScaling
from torchrl_tsallis.run import Run, rate, train
from torchrl_tsallis.runs.members import Split, make_splits, train_members
from torchrl_tsallis.runs.tables import SIGNALS

STEPS = 300
CORRUPTED = {"3", "8"}


@pytest.fixture(scope="module")
def run(file, tmp_path_factory):
    return rate(file, tmp_path_factory.mktemp("runs") / "run", steps=STEPS, progress=False)


@pytest.fixture(scope="module")
def policy(file, tmp_path_factory):
    return train(file, tmp_path_factory.mktemp("runs") / "policy", steps=100, seed=3, progress=False)


def test_the_corrupted_episodes_rank_worst_and_are_named(run):
    worst = sorted(run.episodes, key=lambda row: -float(row["surprise"]))[:2]
    assert {row["source"] for row in worst} == CORRUPTED
    assert run.summary["usable"]
    assert run.summary["sentence"].startswith(("Look first at 3, 8: 2 of 12", "Look first at 8, 3: 2 of 12"))


def test_the_tables_say_the_same_of_rows_and_of_episodes(run):
    rows, episodes = run.ratings, run.episodes
    assert [int(row["row"]) for row in rows] == list(range(720))
    assert [int(row["step"]) for row in rows] == 12 * list(range(60))
    for k, episode in enumerate(episodes):
        own = np.array([float(row["surprise"]) for row in rows if int(row["episode"]) == k])
        assert int(episode["steps"]) == len(own) == 60
        assert int(episode["worst_step"]) == own.argmax()
        assert float(episode["share_over_3"]) == pytest.approx((own >= 3).mean(), abs=1e-5)
        assert float(episode["low"]) <= float(episode["surprise"]) <= float(episode["high"])
    share = np.mean([float(row["rating"]) for row in rows if row["episode"] in CORRUPTED])
    assert share < 0.5 * np.mean([float(row["rating"]) for row in rows if row["episode"] not in CORRUPTED])


def test_a_logger_gets_the_table_of_the_episodes_and_the_histogram_of_the_steps(data, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from torchrl.record.loggers.tensorboard import TensorboardLogger

    logger = TensorboardLogger("door", log_dir=str(tmp_path / "logs"))
    rate(data, tmp_path / "run", steps=10, seeds=2, progress=False, logger=logger)
    logger.experiment.close()
    events = EventAccumulator(str(logger.log_dir), size_guidance={"histograms": 0}).Reload()
    assert events.Tags()["histograms"] == ["ratings/surprise"]
    (tag,) = events.Tags()["tensors"]
    assert len(events.Tensors(tag)[0].tensor_proto.string_val[0].decode().split("\n")) == 2 + 12


@pytest.mark.parametrize("logger", ["wandb", CSVLogger, []])
def test_what_is_no_logger_is_refused_before_the_training(data, tmp_path, logger):
    with pytest.raises(TypeError, match="logger must be one of TorchRL's, as make_logger makes them, got "):
        rate(data, tmp_path / "run", progress=False, logger=logger)
    assert not (tmp_path / "run").exists()


def test_rating_imports_neither_the_report_nor_a_logger():
    code = "import sys, torchrl_tsallis.run; print([m for m in sys.modules if m.startswith(NAMES)])"
    names = ("torchrl_tsallis.report", "torchrl_tsallis.commands", "jinja2", "matplotlib", "wandb", "tensorboard")
    command = [sys.executable, "-c", code.replace("NAMES", repr(names))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == "[]"


def test_every_row_is_rated_by_policies_that_did_not_see_it(data):
    splits = make_splits(data, seeds=3, folds=2)
    for seed in range(3):
        own = [split.held_out for split in splits if split.seed == seed]
        assert torch.stack(own).sum(0).eq(1).all()
    assert not torch.equal(splits[0].held_out, splits[2].held_out)  # seeds deal the episodes anew


def test_the_run_says_what_was_read_and_how(run, file):
    settings = json.loads((run.folder / "run.json").read_text())
    assert settings["data"]["path"] == str(file)
    assert settings["data"]["keys"] == {"observation": ["observations"], "action": ["actions"]}
    assert (settings["data"]["episodes"], settings["data"]["steps"]) == (12, 720)
    assert settings["train"] == {"steps": STEPS, "batch_size": 256, "seeds": 3, "folds": 2, "lr": 1e-3}
    assert settings["method"]["u"] == pytest.approx(run.summary["u"][-1])
    assert len(run.summary["u"]) == 7  # 3 seeds of 2 folds, and one policy of everything


def test_an_opened_run_has_the_policy_and_rating_that_were_trained(policy, data, file):
    members = train_members(data, [Split(3, torch.zeros(720, dtype=torch.bool))], steps=100, batch_size=256)
    (scaling,) = members.scalings
    (distance,), (rating,) = members.ask(data)
    again = Run.open(policy.folder)
    torch.testing.assert_close(again.rate(file), rating, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(again.rate(data), again.rate(file), rtol=0, atol=0)
    # A = 2: the survival function of chi-squared is exp(-Z / 2)
    torch.testing.assert_close(again.surprise(file), distance / 2 / np.log(10), rtol=1e-4, atol=1e-5)
    network = members.loss.actor_network_params.data[0]
    with network.to_module(members.loss.actor_network):
        wanted = members.loss.actor_network.get_dist(scaling(data.select("observation")))
    dist = again.actor().get_dist(data.select("observation"))
    torch.testing.assert_close(dist.mode, scaling.unscale_action(wanted.mode), rtol=1e-5, atol=1e-6)
    change = scaling.scales["action"].log().sum()  # of units
    density = wanted.log_prob(scaling.scale("action", data["action"])) - change
    torch.testing.assert_close(dist.log_prob(data["action"]), density.float(), rtol=1e-4, atol=1e-4)
    mean = again.numpy_policy()(data["observation"].numpy())
    np.testing.assert_allclose(mean, dist.mode.detach().numpy(), rtol=1e-4, atol=1e-5)


def test_the_callers_random_numbers_stay_as_they_are(file, tmp_path):
    torch.manual_seed(1)
    wanted = torch.rand(3)
    torch.manual_seed(1)
    train(file, tmp_path / "run", steps=3, progress=False)
    assert torch.equal(torch.rand(3), wanted)


@pytest.mark.parametrize(("observation", "action"), [(1e-3, 1e3), (1e3, 1e-3)])
def test_ratings_tables_and_policy_are_the_same_in_other_units(
    run, policy, write_npz, tmp_path, data, observation, action
):
    other = write_npz(tmp_path / "other.npz", observation, action)
    rated = rate(other, tmp_path / "run", steps=STEPS, progress=False)
    for name in ("surprise", "rating", "surprise_seen"):
        ours, theirs = (np.array([float(row[name]) for row in r.ratings]) for r in (run, rated))
        # rounding grows while a policy trains: what is seen at 12 decades and more counts as 12
        np.testing.assert_allclose(theirs.clip(max=12), ours.clip(max=12), rtol=0.02, atol=0.02, err_msg=name)
    for name in ("surprise", "low", "high", *(set(SIGNALS) - {"deminf"})):
        ours, theirs = (np.array([float(row[name]) for row in r.episodes]) for r in (run, rated))
        np.testing.assert_allclose(theirs, ours, rtol=0.02, atol=0.02, err_msg=name)
    assert rated.summary["sentence"] == run.summary["sentence"]
    trained = train(other, tmp_path / "policy", steps=100, seed=3, progress=False)
    x = data["observation"].numpy()
    mean = trained.numpy_policy()(x * np.float32(observation)) / np.float32(action)
    np.testing.assert_allclose(mean, policy.numpy_policy()(x), rtol=1e-3, atol=1e-3)


def test_units_that_are_powers_of_two_change_no_bit(policy, write_npz, tmp_path):
    trained = train(write_npz(tmp_path / "o.npz", 2.0**-10, 2.0**10), tmp_path / "p", steps=100, seed=3, progress=False)
    for name in ("policy.safetensors", "rating.safetensors"):
        assert (trained.folder / name).read_bytes() == (policy.folder / name).read_bytes()


def test_a_policy_has_a_card_that_says_how_to_load_it(policy, file):
    card = (policy.folder / "README.md").read_text()
    code = card.partition("```python\n")[2].partition("```")[0].replace("DATA", str(file))
    space: dict[str, object] = {}
    exec(code, space)  # the card's own example
    assert space["actor"].out_keys[-1] == "action"
    for text in (str(file), policy.settings["data"]["identity"], "720 steps in 12 episodes", "steps 100", "torchrl"):
        assert text in card
    with pytest.raises(FileNotFoundError, match="run of a policy and has no episodes.csv"):
        _ = policy.episodes


def test_the_reward_and_the_episodes_names_are_in_the_table(tmp_path):
    file = tmp_path / "d.csv"
    with file.open("w") as handle:
        writer = csv.writer(handle)
        writer.writerow(["episode_id", "o1", "o2", "a1", "reward"])
        rng = np.random.default_rng(0)
        for k in range(40):
            writer.writerow([10 + k // 10, *rng.normal(size=3).round(3), 0.5])
    run = rate(
        file, tmp_path / "r", obs=["o1", "o2"], action="a1", episode="episode_id", steps=5, seeds=2, progress=False
    )
    assert [row["return"] for row in run.episodes] == 4 * ["5"]
    assert run.settings["data"]["episode"] == "episode_id"
    assert run.settings["data"]["layout"] == [["o1", 0, 1], ["o2", 1, 2]]
    assert "4 episodes are too few" in run.summary["sentence"]
    assert run.rate(file).shape == (40,)


def test_data_that_a_run_cannot_take_is_refused(policy, data, tmp_path):
    with pytest.raises(ValueError, match=r"have \(3, 1\) dimensions, the run's \(3, 2\)"):
        policy.rate(data.clone().set("action", data["action"][:, :1]))
    with pytest.raises(ValueError, match="pairs without episodes"):
        rate(data.exclude("episode"), tmp_path / "r", steps=5, progress=False)
    with pytest.raises(ValueError, match="13 folds of 12 episodes"):
        rate(data, tmp_path / "r", folds=13, steps=5, progress=False)
    with pytest.raises(ValueError, match="device='cuda:99' is not there"):
        train(data, tmp_path / "r", device="cuda:99", progress=False)
    with pytest.raises(TypeError, match="a path or a TensorDict, got int"):
        train(5, tmp_path / "r")
    assert list(tmp_path.iterdir()) == []


def test_a_policy_of_pairs_without_episodes_can_be_trained(data, tmp_path):
    run = train(data.exclude("episode"), tmp_path / "r", steps=5, progress=False)
    assert run.settings["data"]["episodes"] is None
    assert RobustScaling.fit(data).to_json() == run.scaling.to_json()
