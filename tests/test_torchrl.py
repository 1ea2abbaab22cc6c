"""What the package takes of TorchRL's and tensordict's private parts still is what it was taken for."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import SamplerWithoutReplacement
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from torchrl_tsallis import TsallisBCLoss, _torchrl
from torchrl_tsallis.modules import make_policy

PACKAGE = Path(_torchrl.__file__).parent


@pytest.fixture
def trainer(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "trainers"))
    from train_small import make_trainer

    return make_trainer(None, progress=True)[0]


def test_tensordict_names_its_plain_class_in_the_files_of_a_folder(tmp_path):
    TensorDict({"x": torch.zeros(2)}).memmap(tmp_path)
    assert json.loads((tmp_path / "meta.json").read_text())["_type"] == _torchrl.PLAIN_CLASS


def test_the_logger_is_torchrl_s():
    assert _torchrl.logger.name == "torchrl"


def test_a_trainer_has_its_own_times_of_logging(trainer, monkeypatch):
    from train_small import make_trainer

    other = make_trainer(None)[0]
    assert trainer._last_log is not other._last_log
    trainer._last_log["loss"] = 3
    _torchrl.own_log_times(trainer)
    assert trainer._last_log == {}


def test_the_trainer_s_counters_and_modules(trainer, capsys):
    assert _torchrl.optim_steps(trainer) == 0
    assert {"optimization_stepper", "sampler", "q_tuner", "rng"} == set(_torchrl.registered_modules(trainer))
    trainer.train()
    assert _torchrl.optim_steps(trainer) == 40
    assert "40/40" in capsys.readouterr().err


def test_the_bar_begins_where_the_checkpoint_was(trainer, capsys):
    trainer.collected_frames = 36
    trainer.train()
    assert "40/40" in capsys.readouterr().err and trainer._pbar.n == 40


def test_a_stop_can_be_read_and_withdrawn(trainer):
    assert _torchrl.stop_reason(trainer) is None
    trainer.request_stop("enough")
    assert _torchrl.stop_reason(trainer) == "enough"
    _torchrl.withdraw_stop(trainer)
    assert _torchrl.stop_reason(trainer) is None
    trainer.train()
    assert trainer.collected_frames == 40


def test_the_generator_of_a_sampler_is_the_one_that_was_set():
    sampler, generator = SamplerWithoutReplacement(), torch.Generator()
    assert _torchrl.sampler_rng(sampler) is None
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    TensorDictReplayBuffer(storage=LazyTensorStorage(4), sampler=sampler, batch_size=2).set_rng(generator)
    assert _torchrl.sampler_rng(sampler) is generator


def test_the_reduction_of_losses_selects_the_valid_samples():
    loss = TsallisBCLoss(make_policy(3, 2), gamma_mix=0.0)
    value, mask = torch.tensor([1.0, torch.nan, 3.0]), torch.tensor([True, False, True])
    td = TensorDict({"collector": {"mask": mask}}, [3])
    assert ("collector", "mask") in list(_torchrl.loss_mask_keys(loss))
    assert _torchrl.reduce_loss(loss, value, td) == 2.0
    assert _torchrl.reduce_loss(loss, value, td, reduction="sum") == 4.0
    assert _torchrl.expand_loss_mask(loss, mask, value).equal(mask)
    _torchrl.clear_weakrefs(loss, td, "actor_network_params")


def test_an_updater_knows_sources_and_targets():
    loss = TsallisBCLoss(make_policy(3, 2))
    sources, targets = _torchrl.source_and_target_params(SoftUpdate(loss, eps=0.9))
    assert list(sources.keys()) == ["actor_network_params"] and list(targets.keys()) == ["target_actor_network_params"]
    source, target = sources["actor_network_params"], targets["target_actor_network_params"]
    assert set(source.keys(True, True)) == set(target.keys(True, True)) != set()


def test_an_actor_s_parts_are_in_their_order():
    actor = make_policy(3, 2)
    parts = _torchrl.parts_of(actor)
    assert len(parts) == 2 and parts[0].out_keys == parts[1].in_keys
    assert isinstance(TsallisBCLoss(actor, gamma_mix=0.0), LossModule)


def test_no_other_file_of_the_trainers_and_jobs_uses_a_private_name():
    private = re.compile(r"\b(?:trainer|sampler|rotation|checkpoint|replay_buffer|buffer|loss|loss_module)\._[a-z]\w*")
    imports = re.compile(r"^\s*(?:from|import) (?:torchrl|tensordict)\b.*\b_[a-z]\w*", re.MULTILINE)
    for folder in ("trainers", "jobs"):
        for path in (PACKAGE / folder).glob("*.py"):
            text = re.sub(r"self\._\w+", "", path.read_text(encoding="utf-8"))
            assert not private.findall(text) and not imports.findall(text), path
