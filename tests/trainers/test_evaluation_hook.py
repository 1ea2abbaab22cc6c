"""Evaluation during training: every n steps, without a trace in what is trained, and with early stopping."""

from __future__ import annotations

import random
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_tsallis.trainers import EvaluationHook, make_logger, resume


@pytest.fixture
def small(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import train_small

    return train_small


def scalars(folder: Path, name: str) -> dict[int, float]:
    lines = (folder / "scalars" / f"{name}.csv").read_text().split()
    return {int(step): float(value) for step, value in (line.split(",") for line in lines)}


def test_evaluation_is_logged_and_changes_nothing(small, tmp_path):
    finals = []
    for evaluate in (False, True):
        trainer, loss = small.make_trainer(None, logger=make_logger("csv", tmp_path, f"run{evaluate}"))
        if evaluate:
            EvaluationHook(lambda: {"return": float(torch.rand(()))}, every=8).register(trainer)
        trainer.train()
        finals.append(loss.state_dict())
    assert list(scalars(tmp_path / "runTrue", "eval/return")) == [8, 16, 24, 32, 40]
    assert all(torch.equal(a, b) for a, b in zip(*(final.values() for final in finals), strict=True))


def test_early_stop_after_evaluations_without_a_new_best(small):
    trainer, _ = small.make_trainer(None)
    results = iter([1.0, 3.0, 2.0, 3.0, 9.0])
    hook = EvaluationHook(lambda: {"return": next(results)}, every=4, patience=2)
    hook.register(trainer)
    trainer.train()
    assert trainer.collected_frames == 16
    assert hook.state_dict() == {"best": 3.0, "without_best": 2}


def test_an_evaluation_without_the_monitored_result_names_it(small):
    trainer, _ = small.make_trainer(None)
    EvaluationHook(lambda: {"return": 1.0}, every=4, monitor="median", patience=1).register(trainer)
    with pytest.raises(KeyError, match="return.*median"):
        trainer.train()


@pytest.mark.parametrize("settings", [{"every": 0}, {"every": -1}, {"every": 4, "patience": 0}])
def test_evaluation_hook_refuses_numbers_that_are_not_positive(settings):
    with pytest.raises(ValueError, match=r"^(every|patience) must be an integer of at least 1, got (0|-1)$"):
        EvaluationHook(dict, **settings)


@pytest.mark.parametrize("settings", [{"every": 2.5}, {"every": True}, {"every": 4, "patience": 1.5}])
def test_evaluation_hook_refuses_what_is_no_whole_number(settings):
    with pytest.raises(TypeError, match=r"^(every|patience) must be an integer of at least 1, got "):
        EvaluationHook(dict, **settings)


@pytest.mark.parametrize("every", [2, 6, 3, 42])
def test_an_evaluation_that_would_not_come_every_n_steps_is_refused(small, every):
    with pytest.raises(ValueError, match=rf"every={every} must be a multiple of the trainer's log_every=4"):
        EvaluationHook(dict, every).register(small.make_trainer(None)[0])


def test_an_evaluation_that_would_never_come_is_refused(small):
    with pytest.raises(ValueError, match="every=44 never comes in the trainer's steps=40"):
        EvaluationHook(dict, 44).register(small.make_trainer(None)[0])


def draw():
    return torch.rand(2).tolist(), np.random.rand(2).tolist(), random.random()  # noqa: NPY002


def test_all_random_numbers_are_put_back(small):
    trainer, _ = small.make_trainer(None)
    hook = EvaluationHook(lambda: {"return": draw()[1][0]}, every=4)
    hook.register(trainer)
    torch.manual_seed(0), np.random.seed(0), random.seed(0)
    first, second = draw(), draw()
    torch.manual_seed(0), np.random.seed(0), random.seed(0)
    assert draw() == first
    assert hook(None) is not None
    assert draw() == second


def modes(*modules) -> list[bool]:
    return [module.training for owner in modules for module in owner.modules()]


class Evaluator:
    def __init__(self, policy):
        self.policy = policy

    def __call__(self):
        return evaluate_in(self.policy)

    def method(self):
        return evaluate_in(self.policy)


def evaluate_in(policy):
    policy.train(not policy.training)
    return {"return": 0.0}


@pytest.mark.parametrize(
    "make",
    [
        lambda policy: lambda: evaluate_in(policy),
        lambda policy: partial(evaluate_in, policy),
        lambda policy: partial(evaluate_in, policy=policy),
        Evaluator,
        lambda policy: Evaluator(policy).method,
        lambda policy: lambda policies={"p": policy}: evaluate_in(policies["p"]),
    ],
    ids=["closure", "partial", "keyword", "object", "method", "default"],
)
@pytest.mark.parametrize("owner", ["another", "actor", "loss"])
def test_the_mode_of_every_module_is_put_back(small, make, owner):
    trainer, loss = small.make_trainer(None)
    policy = {"another": torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Dropout()), "loss": loss}.get(owner)
    policy = loss.actor_network if policy is None else policy
    next(policy.children()).eval()  # a part may be in another mode than the whole
    before = modes(policy, loss, loss.actor_network)
    hook = EvaluationHook(make(policy), every=4)
    hook.register(trainer)
    assert hook(None) == {"eval/return": 0.0, "log_pbar": True}
    assert modes(policy, loss, loss.actor_network) == before


def test_modes_are_put_back_after_an_error(small):
    trainer, loss = small.make_trainer(None)

    def fail():
        loss.eval()
        raise OSError("unplugged")

    hook = EvaluationHook(fail, every=4)
    hook.register(trainer)
    with pytest.raises(OSError, match="unplugged"):
        hook(None)
    assert loss.training


def test_results_that_have_no_names_are_refused(small):
    trainer, _ = small.make_trainer(None)
    EvaluationHook(lambda: 1.0, every=4).register(trainer)
    with pytest.raises(TypeError, match="results by name"):
        trainer.train()


def test_a_stopped_training_stays_stopped(small, tmp_path):
    reached = []
    for _ in range(3):
        trainer, _ = small.make_trainer(tmp_path)
        EvaluationHook(lambda: {"return": 0.0}, every=4, patience=2).register(trainer)
        resume(trainer)
        trainer.train()
        trainer.train()
        reached.append((trainer.collected_frames, "not improved" in trainer.collector.stopped))
    assert reached == [(12, True)] * 3
    trainer.collector.go_on()
    trainer.train()
    assert trainer.collected_frames == 16  # one more evaluation without a new best


def test_a_stop_of_another_hook_stays_too_and_a_finished_training_is_not_trained_on(small, tmp_path):
    for _ in range(2):
        trainer, _ = small.make_trainer(tmp_path / "stopped")
        trainer.register_op("post_steps", lambda trainer=trainer: trainer.request_stop())
        resume(trainer)
        trainer.train()
        assert trainer.collected_frames == 4 and trainer.collector.stopped == "stop requested"
    for _ in range(2):
        trainer, loss = small.make_trainer(tmp_path / "finished")
        resume(trainer)
        trainer.train()
        assert trainer.collected_frames == 40 and trainer.collector.stopped is None
    more, _ = small.make_trainer(tmp_path / "finished", steps=48)
    assert resume(more) == 40
    more.train()
    assert more.collected_frames == 48
