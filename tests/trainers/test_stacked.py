"""A member of a stacked run equals the run that it would be by itself."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import distributions as d
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis import AdaTerm, CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer, make_stacked_replay_buffer
from torchrl_tsallis.modules import NormalHead, make_policy
from torchrl_tsallis.trainers import make_logger, make_offline_trainer, resume

METHODS = {
    "bc": (1.0, 0.0, False),
    "q_bc": (0.8, 0.0, False),
    "q_kl": (0.8, 1.0, False),
    "adaptive_gamma": (0.7, "adaptive", False),
    "proposal": (0.8, "adaptive", True),
    "adaptive_q": (0.8, 0.0, True),
}


def make_actor(seed: int):
    torch.manual_seed(seed)
    return make_policy(3, 2, hidden=(8, 8))


def data_of(seed: int, rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(100 + seed)
    observation = torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    action = observation[:, :2].tanh() + 0.2 * noise
    action[::7] += 5.0
    return TensorDict({"observation": observation, "action": action}, [rows])


def solo_step(method: str, actor):
    q, gamma, tune = METHODS[method]
    loss = TsallisBCLoss(actor, q=q, gamma_mix=gamma).double()
    optimizer = AdaTerm(loss.parameters(), lr=1e-2)
    updater = CATSoftUpdate(loss) if loss.needs_target else None
    tuner = QTuner(loss, lr=1e-2) if tune else None
    return loss, stepper(loss, optimizer, updater, tuner)


def stacked_step(methods: list[str], actors: list):
    q, gamma, tuned = (list(column) for column in zip(*(METHODS[method] for method in methods), strict=True))
    loss = TsallisBCLoss(actors, q=q, gamma_mix=gamma).double()
    optimizer = AdaTerm(loss.parameters(), lr=1e-2, batch_dims=1)
    return loss, stepper(loss, optimizer, CATSoftUpdate(loss), QTuner(loss, tuned=tuned, lr=1e-2))


def stepper(loss, optimizer, updater, tuner):
    def step(batch):
        out = loss(batch)
        out["loss_tsallis_bc"].backward()
        optimizer.step()
        optimizer.zero_grad()
        if updater is not None:
            updater.step()
        if tuner is not None:
            tuner.step()
        return out.detach()

    return step


def test_members_of_all_methods_equal_their_solo_runs():
    methods = list(METHODS)
    actors = [make_actor(seed).double() for seed in range(len(methods))]
    initial = [{k: v.clone() for k, v in actor.state_dict().items()} for actor in actors]
    data = [data_of(seed) for seed in range(len(methods))]
    generator = torch.Generator().manual_seed(0)
    rows = torch.stack([torch.randperm(64, generator=generator)[:16] for _ in range(100)])
    loss, step = stacked_step(methods, actors)
    outs = [step(torch.stack([member[index] for member in data])) for index in rows]
    for k, method in enumerate(methods):
        actor = make_actor(k).double()
        solo, solo_stepper = solo_step(method, actor)
        solo_outs = [solo_stepper(data[k][index]) for index in rows]
        for name, value in loss.member_state_dict(k).items():
            torch.testing.assert_close(value, actor.state_dict()[name], rtol=1e-4, atol=1e-8)
        for out, solo_out in zip(outs, solo_outs, strict=True):
            for name in set(solo.out_keys) - {"loss_tsallis_bc"}:
                torch.testing.assert_close(out[name][k], solo_out[name], rtol=1e-4, atol=1e-8)
    for out in outs:
        assert out["loss_tsallis_bc"].ndim == 0
    assert all(torch.equal(a.state_dict()[n], v) for a, i in zip(actors, initial, strict=True) for n, v in i.items())


def test_a_list_of_one_policy_equals_the_policy_by_itself():
    data = data_of(0)
    loss, step = stacked_step(["proposal"], [make_actor(0)])
    actor = make_actor(0).double()
    solo_loss, solo_step_ = solo_step("proposal", actor)
    assert len(list(loss.parameters())) == len(list(solo_loss.parameters())) > 0
    for k in range(4):
        step(data[None, 16 * k : 16 * k + 16])
        solo_step_(data[16 * k : 16 * k + 16])
    for name, value in loss.member_state_dict(0).items():
        torch.testing.assert_close(value, actor.state_dict()[name], rtol=1e-4, atol=1e-8)


def make_trainer(methods: list[str], seeds: list[int], folder=None, steps: int = 24, bad: int | None = None, **kwargs):
    """A stacked run, or with one method and seed a single one, through the offline trainer."""
    data = [data_of(seed) for seed in seeds]
    settings = {"steps": steps, "log_every": 4, "checkpoint_dir": folder, "checkpoint_every": 4, "progress": False}
    actors = [make_actor(seed) for seed in seeds]
    q, gamma, tuned = (list(column) for column in zip(*(METHODS[method] for method in methods), strict=True))
    if len(methods) == 1:
        loss = TsallisBCLoss(actors[0], q=q[0], gamma_mix=gamma[0]).double()
        buffer = make_replay_buffer(data[0], batch_size=16, seed=seeds[0])
        updater = CATSoftUpdate(loss) if loss.needs_target else None
        tuner = QTuner(loss, lr=1e-2) if tuned[0] else None
        optimizer = AdaTerm(loss.parameters(), lr=1e-2)
    else:
        loss = TsallisBCLoss(actors, q=q, gamma_mix=gamma).double()
        buffer = make_stacked_replay_buffer(data, batch_size=16, seeds=seeds)
        updater, tuner = CATSoftUpdate(loss), QTuner(loss, tuned=tuned, lr=1e-2)
        optimizer = AdaTerm(loss.parameters(), lr=1e-2, batch_dims=1)
    trainer = make_offline_trainer(loss, buffer, optimizer, updater=updater, tuner=tuner, **settings, **kwargs)

    def spoil(batch):
        batch["observation"][bad] = torch.inf
        return batch

    if bad is not None:
        trainer.register_op("process_optim_batch", spoil)
    return trainer


@pytest.mark.parametrize("clip_norm", [None, 0.5])
def test_through_the_trainer_members_equal_their_solo_runs(clip_norm):
    methods = ["bc", "proposal", "q_kl"]
    together = make_trainer(methods, [3, 4, 5], clip_norm=clip_norm)
    together.train()
    for k, method in enumerate(methods):
        alone = make_trainer([method], [3 + k], clip_norm=clip_norm)
        alone.train()
        expected = alone.loss_module.actor_network_params.data.flatten_keys(".")
        for name, value in together.loss_module.member_state_dict(k).items():
            torch.testing.assert_close(value, expected[name], rtol=1e-6, atol=1e-10)


def test_resumed_run_is_bit_for_bit(tmp_path):
    methods = ["q_bc", "proposal"]
    whole = make_trainer(methods, [0, 1])
    whole.train()
    make_trainer(methods, [0, 1], tmp_path, steps=12).train()
    rest = make_trainer(methods, [0, 1], tmp_path)
    assert resume(rest) == 12
    rest.train()
    for name, value in whole.loss_module.state_dict().items():
        assert torch.equal(value, rest.loss_module.state_dict()[name]), name


def test_a_bad_member_neither_stops_nor_changes_the_others():
    methods = ["q_bc", "proposal", "proposal"]
    good, bad = make_trainer(methods, [0, 1, 2], max_skips=2), make_trainer(methods, [0, 1, 2], bad=1, max_skips=2)
    start = bad.loss_module.member_state_dict(1)
    good.train(), bad.train()
    for k in (0, 2):
        for name, value in good.loss_module.member_state_dict(k).items():
            torch.testing.assert_close(value, bad.loss_module.member_state_dict(k)[name], rtol=1e-9, atol=1e-12)
    for name, value in bad.loss_module.member_state_dict(1).items():
        torch.testing.assert_close(value, start[name])  # CAT-soft's first pull is none: the target is where it was
    assert bad.optimization_stepper.skipped.tolist() == [0, 24, 0]


def test_only_bad_members_stop_the_training():
    trainer = make_trainer(["bc", "bc"], [0, 1], max_skips=2)
    trainer.loss_module.actor_network_params.data.apply_(lambda x: x.fill_(torch.nan))
    with pytest.raises(FloatingPointError, match="3 steps in a row"):
        trainer.train()


def test_each_member_is_logged(tmp_path):
    logger = make_logger("csv", tmp_path, "run")
    make_trainer(["bc", "proposal"], [0, 1], logger=logger).train()
    names = {str(path.relative_to(tmp_path / "run" / "scalars")) for path in tmp_path.rglob("*.csv")}
    assert {"loss_tsallis_bc.csv", "member_loss/00.csv", "rating_mean/01.csv", "q/01.csv", "grad_norm/00.csv"} <= names


def test_masked_members_are_rated_by_their_valid_samples():
    loss = TsallisBCLoss([make_actor(0), make_actor(1)], gamma_mix=["adaptive", 0.0]).double()
    CATSoftUpdate(loss)
    data = torch.stack([data_of(0, 12), data_of(1, 12)])
    mask = torch.ones(2, 12, dtype=torch.bool)
    mask[0, 5:] = False
    data["observation"][0, 5:] = torch.nan
    tuner = QTuner(loss)
    masked = data.clone().set(("collector", "mask"), mask)
    out, objective = loss(masked), tuner.step()
    for reduction in ("mean", "sum"):
        loss.reduction = reduction
        got = loss(masked)["loss_tsallis_bc"]
        torch.testing.assert_close(got, loss(masked)["member_loss"].sum())
    loss.reduction = "none"
    assert loss(masked)["loss_tsallis_bc"].shape == (2, 12)
    assert loss.rating(data[:, :5]).shape == (2, 5)
    for k, rows in enumerate((5, 12)):
        solo = TsallisBCLoss(make_actor(k), gamma_mix=["adaptive", 0.0][k]).double()
        CATSoftUpdate(solo)
        solo_tuner = QTuner(solo)
        expected = solo(data[k, :rows])
        for name in set(solo.out_keys) - {"loss_tsallis_bc"}:
            torch.testing.assert_close(out[name][k], expected[name])
        torch.testing.assert_close(out["member_loss"][k], expected["loss_tsallis_bc"].detach())
        torch.testing.assert_close(objective[k], solo_tuner.step())


def test_target_network_iff_a_member_needs_it_and_pull_only_where_it_does():
    actors = [make_actor(0), make_actor(1)]
    assert not TsallisBCLoss(actors, gamma_mix=0.0).needs_target
    loss = TsallisBCLoss(actors, gamma_mix=[0.0, "adaptive"])
    assert loss.needs_target
    updater = CATSoftUpdate(loss)
    with torch.no_grad():
        for value in loss.actor_network_params.values(True, True):
            value.add_(1.0)
    before = [loss.member_state_dict(k) for k in range(2)]
    updater.step()
    moved = [any(not torch.equal(v, before[k][n]) for n, v in loss.member_state_dict(k).items()) for k in range(2)]
    assert moved == [False, True]


def test_an_untuned_member_keeps_its_q():
    loss = TsallisBCLoss([make_actor(0), make_actor(1)], q=[0.9, 0.9], gamma_mix=[1.0, 0.0])
    tuner = QTuner(loss, tuned=[False, True], optimizer=lambda params: torch.optim.SGD(params, lr=0.01))
    objective = tuner.step(torch.full((2, 16), 2.0))
    assert loss.q[0] == torch.tensor(0.9)
    assert loss.q[1] > 0.801
    assert objective[0] == 0


@pytest.mark.parametrize("chain", [False, True])
def test_any_actor_can_be_stacked(chain):
    def build(seed):
        torch.manual_seed(seed)
        if not chain:
            module = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
            return ProbabilisticActor(module, in_keys=["logits"], distribution_class=d.Categorical)
        body = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["hidden"])
        head = TensorDictModule(NormalHead(), in_keys=["hidden"], out_keys=["loc", "scale"])
        return ProbabilisticActor(
            TensorDictSequential(body, head), in_keys=["loc", "scale"], distribution_class=IndependentNormal
        )

    action = torch.randn(2, 5, 2) if chain else torch.arange(10).reshape(2, 5) % 4
    data = TensorDict({"observation": torch.randn(2, 5, 3), "action": action}, [2, 5])
    loss = TsallisBCLoss([build(0), build(1)], gamma_mix=0.0)
    out = loss(data)
    for k in range(2):
        expected = TsallisBCLoss(build(k), gamma_mix=0.0)(data[k])
        torch.testing.assert_close(out["member_loss"][k], expected["loss_tsallis_bc"].detach())


def test_errors_of_stacked_members():
    actors = [make_actor(0), make_actor(1)]
    with pytest.raises(ValueError, match="q has 3 values for 2 policies"):
        TsallisBCLoss(actors, q=[0.8, 0.8, 0.8])
    with pytest.raises(ValueError, match="gamma_mix has 2 values for 1 policies: give a number or one of each"):
        TsallisBCLoss(actors[0], gamma_mix=[0.0, 1.0])
    with pytest.raises(ValueError, match="gamma_mix must be"):
        TsallisBCLoss(actors, gamma_mix=[0.0, "auto"])
    loss = TsallisBCLoss(actors, gamma_mix=[0.0, 1.0]).double()
    CATSoftUpdate(loss)
    with pytest.raises(ValueError, match="2 members first"):
        loss(data_of(0))
    with pytest.raises(ValueError, match="gamma_mix < 1"):
        QTuner(loss)
    with pytest.raises(ValueError, match="tuned has 3 values for 2"):
        QTuner(loss, tuned=[True, False, False])
    with pytest.raises(ValueError, match="actor.state_dict"):
        TsallisBCLoss(actors[0], gamma_mix=0.0).member_state_dict(0)
