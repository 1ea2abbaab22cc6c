"""Hydra configurations: every argument with its default, and a trainer built from a file."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, fields

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("hydra")
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from torchrl_tsallis import (
    AdaTerm,
    CATSoftUpdate,
    PeakRating,
    PredictiveBCLoss,
    QTuner,
    ScoreTuner,
    TsallisBCLoss,
    TsallisRating,
)
from torchrl_tsallis.data import make_replay_buffer
from torchrl_tsallis.modules import make_policy, make_recurrent_policy
from torchrl_tsallis.trainers import configs, make_offline_trainer

PAIRS = [
    (configs.PolicyConfig, make_policy, set()),
    (configs.RecurrentPolicyConfig, make_recurrent_policy, set()),
    (configs.TsallisBCLossConfig, TsallisBCLoss, set()),
    (configs.PredictiveBCLossConfig, PredictiveBCLoss, set()),
    (configs.CATSoftUpdateConfig, CATSoftUpdate, {"loss_module"}),
    (configs.AdaTermConfig, AdaTerm, {"params"}),
    (configs.QTunerConfig, QTuner, {"loss"}),
    (configs.ScoreTunerConfig, ScoreTuner, {"loss"}),
    (configs.TsallisRatingConfig, TsallisRating, set()),
    (configs.PeakRatingConfig, PeakRating, set()),
    (configs.OfflineTrainerConfig, make_offline_trainer, set()),
]


def defaults(target) -> dict:
    return {k: p.default for k, p in inspect.signature(target).parameters.items() if k != "self"}


@pytest.mark.parametrize(("config", "target", "later"), PAIRS, ids=lambda x: getattr(x, "__name__", ""))
def test_every_argument_is_a_field_with_the_same_default(config, target, later):
    known = {f.name: f for f in fields(config) if not f.name.startswith("_")}
    arguments = defaults(target)
    for keywords, further in (("settings", TsallisBCLoss), ("tsallis", TsallisRating)):
        if arguments.pop(keywords, None) is not None:  # handed on; of a rating's settings None is its own default
            arguments |= defaults(further) if further is TsallisBCLoss else dict.fromkeys(defaults(further))
    assert set(known) - later == set(arguments) - later
    for name, default in arguments.items():
        if name in later or default is inspect.Parameter.empty:
            continue
        f = known[name]
        own = f.default if f.default is not MISSING else f.default_factory()
        assert (tuple(own) if isinstance(own, list) else own) == default, name


YAML = """
defaults:
  - model@actor: tsallis_bc
  - loss@loss: tsallis_bc
  - optimizer@optimizer: adaterm
  - target_net_updater@updater: cat_soft
  - tuner@tuner: q_tuner
  - trainer@trainer: offline
  - _self_
actor: {obs_dim: 3, action_dim: 2, hidden: [4]}
loss: {actor_network: "${actor}"}
trainer:
  loss: ${loss}
  optimizer: ${optimizer}
  updater: ${updater}
  tuner: ${tuner}
  steps: 4
  log_every: 2
  progress: false
"""


@pytest.mark.parametrize("gamma_mix", ["adaptive", 0.0])
def test_a_trainer_from_a_file(tmp_path, gamma_mix):
    (tmp_path / "config.yaml").write_text(YAML)
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        cfg = compose("config", [f"loss.gamma_mix={gamma_mix}", "optimizer.lr=0.01"])
    data = TensorDict({"observation": torch.randn(8, 3), "action": torch.randn(8, 2)}, [8])
    trainer = instantiate(cfg.trainer, replay_buffer=make_replay_buffer(data, batch_size=4))
    before = [p.detach().clone() for p in trainer.loss_module.parameters()]
    trainer.train()
    assert trainer.loss_module.needs_target == (gamma_mix == "adaptive")
    assert isinstance(trainer.optimizer, AdaTerm) and trainer.optimizer.param_groups[0]["lr"] == 0.01
    assert all((a != b).any() for a, b in zip(before, trainer.loss_module.parameters(), strict=True))
    assert trainer._modules["q_tuner"].phi.item() != 0.0


def test_parts_alone_are_partials():
    loss = TsallisBCLoss(make_policy(3, 2))
    assert isinstance(instantiate(OmegaConf.structured(configs.AdaTermConfig()))(loss.parameters()), AdaTerm)
    assert isinstance(instantiate(OmegaConf.structured(configs.QTunerConfig()))(loss), QTuner)
    updater = OmegaConf.structured(configs.CATSoftUpdateConfig(loss_module=None))
    assert isinstance(instantiate({k: v for k, v in updater.items() if k != "loss_module"})(loss), CATSoftUpdate)
