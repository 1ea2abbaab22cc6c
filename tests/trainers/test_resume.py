"""A resumed run keeps its settings, its schedule and its folder, or says what is different."""

from __future__ import annotations

import json
import math
import zipfile
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.optim.lr_scheduler import CosineAnnealingLR, ExponentialLR, LinearLR, ReduceLROnPlateau, SequentialLR

from torchrl_tsallis import AdaTerm, CATSoftUpdate, QTuner, TsallisBCLoss
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.trainers import make_logger, make_offline_trainer, resume


@pytest.fixture
def small(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import train_small

    return train_small


BASE = {"lr": 1e-3, "q": 0.8, "tau": 0.1, "multiplier": 100.0, "tuner_lr": 1e-3, "gamma_min": 0.1, "batch_size": 16}


def make(small, folder, *, tuned=True, optimizer=AdaTerm, overwrite=False, **settings):
    """A trainer whose settings can all be chosen."""
    own = {name: settings.pop(name, value) for name, value in BASE.items()}
    torch.manual_seed(1)
    loss = TsallisBCLoss(make_policy(3, 2, hidden=(8,)), q=own["q"], gamma_min=own["gamma_min"])
    defaults = {"steps": 40, "log_every": 4, "checkpoint_every": 8, "progress": False}
    return make_offline_trainer(
        loss,
        make_replay_buffer(small.make_data(), batch_size=own["batch_size"], seed=2),
        optimizer(loss.parameters(), lr=own["lr"]),
        updater=CATSoftUpdate(loss, tau=own["tau"]),
        tuner=QTuner(loss, multiplier=own["multiplier"], lr=own["tuner_lr"]) if tuned else None,
        checkpoint_dir=folder,
        overwrite=overwrite,
        **(defaults | settings),
    )


CHANGES = {
    "optimizer.lr": ({}, {"lr": 0.01}),
    "trainer.clip_norm": ({}, {"clip_norm": 0.5}),
    "optimization_stepper.max_skips": ({}, {"max_skips": 3}),
    "trainer.log_every": ({}, {"log_every": 8}),
    "updater.tau": ({}, {"tau": 0.2}),
    "q_tuner.multiplier": ({}, {"multiplier": 10.0}),
    "q_tuner.optimizer.lr": ({}, {"tuner_lr": 0.01}),
    "loss.q": ({"tuned": False}, {"tuned": False, "q": 0.9}),
    "loss.rating_module.gamma_low": ({}, {"gamma_min": 0.2}),
    "buffer.batch_size": ({}, {"batch_size": 8}),
    "optimizer.class": ({}, {"optimizer": torch.optim.Adam}),
    "q_tuner.class": ({}, {"tuned": False}),
    "lr_schedule.class": ({}, {"lr_schedule": partial(ExponentialLR, gamma=0.9)}),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_setting_is_named_and_nothing_is_loaded(small, tmp_path, name):
    before, after = CHANGES[name]
    make(small, tmp_path, **before, **{"steps": 8}).train()
    again = make(small, tmp_path, **before)
    assert resume(again) == 8  # more steps are no other settings
    other = make(small, tmp_path, **after)
    state = {key: value.clone() for key, value in other.loss_module.state_dict().items()}
    with pytest.raises(ValueError, match=rf"{name} was .* and is .*settings='checkpoint'.*settings='new'"):
        resume(other)
    assert all(torch.equal(value, state[key]) for key, value in other.loss_module.state_dict().items())


def test_the_checkpoint_s_learning_rate_can_be_kept(small, tmp_path):
    whole = make(small, None)
    whole.train()
    make(small, tmp_path, steps=16).train()
    rest = make(small, tmp_path, lr=0.5, tuner_lr=0.5)
    assert resume(rest, settings="checkpoint") == 16
    rest.train()
    for key, value in whole.loss_module.state_dict().items():
        assert torch.equal(value, rest.loss_module.state_dict()[key]), key
    assert resume(make(small, tmp_path), settings="refuse") == 40  # its checkpoints say what held


def test_the_new_settings_can_be_taken(small, tmp_path):
    make(small, tmp_path, steps=16, tuned=False).train()
    new = {"lr": 0.5, "tau": 0.2, "q": 0.9, "clip_norm": 0.5, "tuned": False}
    rest = make(small, tmp_path, **new)
    assert resume(rest, settings="new") == 16
    assert rest.optimizer.param_groups[0]["lr"] == 0.5
    assert rest.loss_module.q == torch.tensor(0.9)
    assert rest.target_net_updater.tau == 0.2 and rest.clip_norm == 0.5
    rest.train()
    assert resume(make(small, tmp_path, **new)) == 40


def test_what_was_made_already_cannot_be_given_back(small, tmp_path):
    make(small, tmp_path, steps=8).train()
    with pytest.raises(ValueError, match="cannot give back all.*those of trainer.clip_norm, updater.tau"):
        resume(make(small, tmp_path, clip_norm=1.0, tau=0.3), settings="checkpoint")


@pytest.mark.parametrize("settings", ["checkpoint", "new"])
def test_another_optimizer_is_never_given_the_state(small, tmp_path, settings):
    make(small, tmp_path, steps=8).train()
    with pytest.raises(ValueError, match="state of one does not fit another"):
        resume(make(small, tmp_path, optimizer=torch.optim.Adam), settings=settings)


def test_a_part_can_be_added_or_left_out_with_new_settings(small, tmp_path):
    make(small, tmp_path, steps=8).train()
    without = make(small, tmp_path, tuned=False)
    assert resume(without, settings="new") == 8
    without.train()
    assert resume(make(small, tmp_path, steps=48), settings="new") == 40


def test_a_log_every_that_does_not_divide_the_step_is_refused(small, tmp_path):
    make(small, tmp_path, steps=8).train()
    with pytest.raises(ValueError, match="step 8, which is no multiple of the new log_every=5"):
        resume(make(small, tmp_path, steps=40, log_every=5, checkpoint_every=5), settings="new")


def test_an_unknown_choice_is_refused(small, tmp_path):
    with pytest.raises(ValueError, match="no settings 'old': choose refuse, checkpoint, new"):
        resume(make(small, tmp_path), settings="old")


SCHEDULES = {
    "cosine": partial(CosineAnnealingLR, T_max=40),
    "exponential": partial(ExponentialLR, gamma=0.9),
    "warm-up": partial(LinearLR, start_factor=0.1, total_iters=30),
    "two": lambda o: SequentialLR(o, [LinearLR(o, 0.1, total_iters=10), ExponentialLR(o, 0.9)], [10]),
}


@pytest.mark.filterwarnings("ignore:.*epoch parameter in:UserWarning")  # of torch's own SequentialLR
@pytest.mark.parametrize("name", SCHEDULES)
def test_a_schedule_is_resumed_bit_for_bit_and_logged(small, tmp_path, name):
    schedule, logger = SCHEDULES[name], make_logger("csv", tmp_path, "run")
    whole = make(small, None, lr_schedule=schedule, logger=logger)
    whole.train()
    make(small, tmp_path / "c", steps=16, lr_schedule=schedule).train()
    rest = make(small, tmp_path / "c", lr_schedule=schedule)
    assert resume(rest) == 16
    rest.train()
    assert rest.optimizer.param_groups[0]["lr"] == whole.optimizer.param_groups[0]["lr"] != 1e-3
    for key, value in whole.loss_module.state_dict().items():
        assert torch.equal(value, rest.loss_module.state_dict()[key]), key
    rows = (tmp_path / "run" / "scalars" / "lr.csv").read_text().split()
    assert rows[-1] == f"40,{whole.optimizer.param_groups[0]['lr']}" and len(rows) == 10


def test_the_cosine_s_rate_is_that_of_its_formula(small):
    trainer = make(small, None, steps=20, lr_schedule=partial(CosineAnnealingLR, T_max=40))
    trainer.train()
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 * (1 + math.cos(math.pi / 2)) / 2)


@pytest.mark.parametrize("change", [{"lr": 0.01}, {"lr_schedule": partial(CosineAnnealingLR, T_max=80)}])
def test_a_new_schedule_is_replayed_up_to_the_step(small, tmp_path, change):
    settings = {"lr_schedule": partial(CosineAnnealingLR, T_max=40)}
    make(small, tmp_path, steps=16, **settings).train()
    with pytest.raises(ValueError, match="(base_lrs|T_max) was"):
        resume(make(small, tmp_path, **(settings | change)))
    rest = make(small, tmp_path, **(settings | change))
    resume(rest, settings="new")
    whole = make(small, None, steps=16, **(settings | change))
    whole.train()
    assert rest.optimizer.param_groups[0]["lr"] == pytest.approx(whole.optimizer.param_groups[0]["lr"], rel=1e-12)
    rest.train()


@pytest.mark.parametrize("schedule", [ReduceLROnPlateau, lambda optimizer: None, 0.1])
def test_what_is_no_schedule_is_refused(small, schedule):
    with pytest.raises(TypeError, match="lr_schedule must"):
        make(small, None, lr_schedule=schedule)


@pytest.mark.parametrize("where", ["format_version", "adapter_version"])
@pytest.mark.parametrize("form", ["archive", "folder"])
def test_a_newer_format_is_called_that(small, tmp_path, where, form):
    make(small, tmp_path, steps=8).train()
    path = tmp_path / "checkpoint-000000000008.torchrl"
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    manifest = json.loads(members["manifest.json"])
    (manifest if where == "format_version" else manifest["components"]["optimizer"])[where] = 7
    members["manifest.json"] = json.dumps(manifest).encode()
    if form == "archive":
        with zipfile.ZipFile(path, "w") as file:
            for name, content in members.items():
                file.writestr(name, content)
    else:
        path.unlink()
        for name, content in members.items():
            target = path.with_suffix("") / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
    with pytest.raises(RuntimeError, match="of the newer format 7, this version reads 1: update torchrl") as error:
        resume(make(small, tmp_path))
    assert "delete" not in str(error.value)


@pytest.mark.parametrize("how", ["resume", "anew"])
def test_what_killed_writes_have_left_is_removed(small, tmp_path, how):
    name = "checkpoint-000000000008.torchrl"
    for kind in ("stage", "archive", "delete"):
        (tmp_path / f".{name}.{kind}-{'0' * 32}").mkdir()
        (tmp_path / f".{name}.{kind}-{'0' * 32}" / "half").write_text("")
    (tmp_path / f".{name}.archive-{'1' * 32}").write_text("")
    keep = tmp_path / ".checkpoint-notes"
    keep.write_text("")
    trainer = make(small, tmp_path, steps=8)
    if how == "resume":
        resume(trainer)
        assert list(tmp_path.iterdir()) == [keep]
    trainer.train()
    assert sorted(path.name for path in tmp_path.iterdir()) == [keep.name, name]


def test_a_checkpoint_that_was_moved_aside_comes_back(small, tmp_path):
    make(small, tmp_path, steps=8).train()
    path = tmp_path / "checkpoint-000000000008.torchrl"
    path.rename(tmp_path / f".{path.name}.backup-{'0' * 32}")
    assert resume(make(small, tmp_path)) == 8
    assert list(tmp_path.iterdir()) == [path]


def test_a_used_folder_is_not_begun_anew_without_a_word(small, tmp_path):
    make(small, tmp_path).train()
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(FileExistsError, match=r"up to step 40 of an earlier run: call resume.*overwrite=True"):
        make(small, tmp_path).train()
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    make(small, tmp_path, steps=8, overwrite=True).train()
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint-000000000008.torchrl"]
    assert resume(make(small, tmp_path)) == 8


@pytest.mark.parametrize("kind", ["csv", "tensorboard"])
def test_a_used_log_is_not_continued_without_a_word(small, tmp_path, kind):
    def logged(**settings):
        return make(small, None, logger=make_logger(kind, tmp_path, "run"), steps=8, **settings)

    for trainer in (logged(), logged(overwrite=True)):
        trainer.train()
        trainer.logger.shutdown()
    trainer = logged()
    with pytest.raises(FileExistsError, match=r"rows up to step 8 of an earlier run.*overwrite=True"):
        trainer.train()
    assert (tmp_path / "run" / "scalars" / "ess.csv").read_text().count("\n") == 2


def test_a_run_that_died_before_its_first_checkpoint_begins_at_zero_with_clean_logs(small, tmp_path):
    def logged():
        return make(small, tmp_path / "c", logger=make_logger("csv", tmp_path, "run"), steps=8)

    trainer = logged()

    def die():
        if trainer.collected_frames == 4:
            raise KeyboardInterrupt

    trainer.register_op("post_steps", die)
    with pytest.raises(KeyboardInterrupt):
        trainer.train()
    assert (tmp_path / "run" / "scalars" / "ess.csv").read_text().startswith("4,")
    trainer = logged()
    assert resume(trainer) == 0
    trainer.train()
    rows = (tmp_path / "run" / "scalars" / "ess.csv").read_text().split()
    assert [row.split(",")[0] for row in rows] == ["4", "8"]


def test_a_checkpoint_without_settings_is_loaded_with_a_warning(small, tmp_path, caplog):
    trainer = make(small, tmp_path, steps=8)
    trainer.checkpoint_metadata = None
    trainer.train()
    assert resume(make(small, tmp_path)) == 8
    assert "does not say by which settings" in caplog.text
