"""Hydra configurations, in the groups and with the conventions of TorchRL's own.

Importing this module registers them in Hydra's ``ConfigStore`` (needs ``hydra-core``):

======================  ===============  =======================================================
group                   name             builds
======================  ===============  =======================================================
``model``               ``tsallis_bc``   :func:`~torchrl_tsallis.modules.make_policy`
``model``               ``recurrent``    :func:`~torchrl_tsallis.modules.make_recurrent_policy`
``loss``                ``tsallis_bc``   :class:`~torchrl_tsallis.TsallisBCLoss`
``loss``                ``predictive``   :class:`~torchrl_tsallis.PredictiveBCLoss`
``target_net_updater``  ``cat_soft``     :class:`~torchrl_tsallis.CATSoftUpdate`
``optimizer``           ``adaterm``      :class:`~torchrl_tsallis.AdaTerm`
``tuner``               ``q_tuner``      :class:`~torchrl_tsallis.QTuner`
``tuner``               ``score_tuner``  :class:`~torchrl_tsallis.ScoreTuner`
``rating``              ``tsallis``      :class:`~torchrl_tsallis.TsallisRating`
``rating``              ``peak``         :class:`~torchrl_tsallis.PeakRating`
``trainer``             ``offline``      :func:`~torchrl_tsallis.trainers.make_offline_trainer`
======================  ===============  =======================================================

Every argument is a field with the same default. What needs the loss or its parameters (updater, tuner, optimizer) is
built as a partial, because a loss that is named twice in a file would be made twice; the trainer completes them::

    defaults:
      - model@actor: tsallis_bc
      - loss@loss: tsallis_bc
      - optimizer@optimizer: adaterm
      - target_net_updater@updater: cat_soft
      - tuner@tuner: q_tuner
      - trainer@trainer: offline
      - _self_
    actor: {obs_dim: 28, action_dim: 8}
    loss: {actor_network: "${actor}"}
    trainer: {loss: "${loss}", optimizer: "${optimizer}", updater: "${updater}", tuner: "${tuner}", steps: 23400}

``instantiate(cfg.trainer, replay_buffer=buffer).train()`` then trains.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms.configs.common import ConfigBase
from torchrl.trainers.algorithms.configs.objectives import LossConfig, TargetNetUpdaterConfig

from torchrl_tsallis.objectives import PredictiveBCLoss, TsallisBCLoss
from torchrl_tsallis.trainers.offline import make_offline_trainer


@dataclass
class PolicyConfig(ConfigBase):
    """Configuration of :func:`~torchrl_tsallis.modules.make_policy`."""

    obs_dim: int = MISSING
    action_dim: int = MISSING
    hidden: list[int] = field(default_factory=lambda: [100, 100])
    observation_key: Any = "observation"
    action_key: Any = "action"
    _target_: str = "torchrl_tsallis.modules.make_policy"
    _convert_: str = "all"

    def __post_init__(self) -> None:
        """Nothing to check: the factory does."""


@dataclass
class RecurrentPolicyConfig(ConfigBase):
    """Configuration of :func:`~torchrl_tsallis.modules.make_recurrent_policy`."""

    obs_dim: int = MISSING
    action_dim: int = MISSING
    hidden_size: int = 100
    num_layers: int = 2
    state_noise: float = 1e-3
    min_scale: float = 0.0
    observation_key: Any = "observation"
    action_key: Any = "action"
    prediction_key: Any = "predicted_observation"
    _target_: str = "torchrl_tsallis.modules.make_recurrent_policy"
    _convert_: str = "all"

    def __post_init__(self) -> None:
        """Nothing to check: the factory does."""


@dataclass
class TsallisBCLossConfig(LossConfig):
    """Configuration of :class:`~torchrl_tsallis.TsallisBCLoss`."""

    actor_network: Any = None
    rating: Any = None
    q: Any = None  # these five: TsallisRating's own defaults
    gamma_mix: Any = None
    gamma_min: float | None = None
    gamma_max: float | None = None
    beta: Any = None
    reduction: str | None = None
    sync_stats: bool = True
    process_group: Any = None
    _target_: str = "torchrl_tsallis.trainers.configs.make_loss"


@dataclass
class PredictiveBCLossConfig(TsallisBCLossConfig):
    """Configuration of :class:`~torchrl_tsallis.PredictiveBCLoss`."""

    prediction_weight: float = 1.0
    rate_prediction: bool = False
    _target_: str = "torchrl_tsallis.trainers.configs.make_predictive_loss"


@dataclass
class TsallisRatingConfig(ConfigBase):
    """Configuration of :class:`~torchrl_tsallis.TsallisRating`."""

    q: Any = 0.8
    gamma_mix: Any = "adaptive"
    gamma_min: float = 0.1
    gamma_max: float = 0.9
    beta: Any = 0.0
    _target_: str = "torchrl_tsallis.TsallisRating"
    _convert_: str = "all"

    def __post_init__(self) -> None:
        """Nothing to check: the rating does."""


@dataclass
class PeakRatingConfig(ConfigBase):
    """Configuration of :class:`~torchrl_tsallis.PeakRating`."""

    u: Any = 0.2
    beta: Any = 0.5
    _target_: str = "torchrl_tsallis.PeakRating"
    _convert_: str = "all"

    def __post_init__(self) -> None:
        """Nothing to check: the rating does."""


@dataclass
class CATSoftUpdateConfig(TargetNetUpdaterConfig):
    """Configuration of :class:`~torchrl_tsallis.CATSoftUpdate`, a partial that waits for the loss."""

    tau: float = 0.1
    strength: float = 1.0
    eps: float = 1e-5
    k: float = 1.0
    init_scale: str = "first"
    _target_: str = "torchrl_tsallis.CATSoftUpdate"


@dataclass
class AdaTermConfig(ConfigBase):
    """Configuration of :class:`~torchrl_tsallis.AdaTerm`, a partial that waits for the parameters."""

    lr: float = 1e-3
    betas: tuple[float, float, float] = (0.9, 0.9, 0.9)
    eps: float = 1e-5
    k: float = 1.0
    weight_decay: float = 0.0
    amsgrad: float = 0.0
    uncentered: bool = False
    adaptive_bias: bool = False
    ini_dof: float | None = None
    batch_dims: int = 0
    skip_nonfinite: bool = True
    _target_: str = "torchrl_tsallis.AdaTerm"
    _convert_: str = "all"  # Hydra's own lists would get into the optimizer's checkpoints
    _partial_: bool = True

    def __post_init__(self) -> None:
        """Nothing to check: the optimizer does."""


@dataclass
class QTunerConfig(ConfigBase):
    """Configuration of :class:`~torchrl_tsallis.QTuner`, a partial that waits for the loss."""

    tuned: list[bool] | None = None
    q_min: float = 0.6
    multiplier: float = 100.0
    lr: float = 1e-3
    optimizer: Any = None
    _target_: str = "torchrl_tsallis.QTuner"
    _partial_: bool = True

    def __post_init__(self) -> None:
        """Nothing to check: the tuner does."""


@dataclass
class ScoreTunerConfig(ConfigBase):
    """Configuration of :class:`~torchrl_tsallis.ScoreTuner`, a partial that waits for the loss."""

    tuned: list[bool] | None = None
    u_max: float = 0.5
    lr: float = 3e-3
    optimizer: Any = None
    _target_: str = "torchrl_tsallis.ScoreTuner"
    _partial_: bool = True

    def __post_init__(self) -> None:
        """Nothing to check: the tuner does."""


@dataclass
class OfflineTrainerConfig(ConfigBase):
    """Configuration of :func:`~torchrl_tsallis.trainers.make_offline_trainer`."""

    loss: Any = MISSING
    replay_buffer: Any = MISSING
    optimizer: Any = MISSING
    steps: int = MISSING
    updater: Any = None
    tuner: Any = None
    logger: Any = None
    log_every: int = 100
    checkpoint_dir: Any = None
    checkpoint_every: int = 1000
    keep_checkpoints: int = 2
    max_skips: int = 10
    clip_norm: float | None = None
    lr_schedule: Any = None
    overwrite: bool = False
    progress: bool = True
    _target_: str = "torchrl_tsallis.trainers.configs.make_trainer"

    def __post_init__(self) -> None:
        """Nothing to check: the factory does."""


def make_loss(actor_network: Any, loss_class: type[TsallisBCLoss] = TsallisBCLoss, **settings: Any) -> TsallisBCLoss:
    """Builds the loss; the actor may come as a partial, as TorchRL's model configurations give it."""
    given = {name: value for name, value in settings.items() if value is not None}
    return loss_class(actor_network() if isinstance(actor_network, partial) else actor_network, **given)


def make_predictive_loss(actor_network: Any, **settings: Any) -> TsallisBCLoss:
    """Builds the loss with the prediction; the actor may come as a partial."""
    return make_loss(actor_network, PredictiveBCLoss, **settings)


def make_trainer(
    loss: TsallisBCLoss, *, optimizer: Any, updater: Any = None, tuner: Any = None, **rest: Any
) -> Trainer:
    """Builds the offline trainer, after completing the partials; an updater that the loss does not need is left out."""
    optimizer = optimizer(loss.parameters()) if isinstance(optimizer, partial) else optimizer
    tuner = tuner(loss) if isinstance(tuner, partial) else tuner
    if not loss.needs_target:
        updater = None
    elif isinstance(updater, partial):
        updater = updater(loss)
    return make_offline_trainer(loss, optimizer=optimizer, updater=updater, tuner=tuner, **rest)


def register() -> None:
    """Stores the configurations in Hydra's ``ConfigStore``."""
    store = ConfigStore.instance()
    for group, name, node in (
        ("model", "tsallis_bc", PolicyConfig),
        ("model", "recurrent", RecurrentPolicyConfig),
        ("loss", "tsallis_bc", TsallisBCLossConfig),
        ("loss", "predictive", PredictiveBCLossConfig),
        ("target_net_updater", "cat_soft", CATSoftUpdateConfig),
        ("optimizer", "adaterm", AdaTermConfig),
        ("tuner", "q_tuner", QTunerConfig),
        ("tuner", "score_tuner", ScoreTunerConfig),
        ("rating", "tsallis", TsallisRatingConfig),
        ("rating", "peak", PeakRatingConfig),
        ("trainer", "offline", OfflineTrainerConfig),
    ):
        store.store(group=group, name=name, node=node)


register()
