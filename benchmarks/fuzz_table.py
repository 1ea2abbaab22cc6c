"""The table of what is fuzzed: public constructors and functions, each with arguments that are valid."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from fuzz_kinds import Allowed, anything, flag, key, kind_of, number, several, whole
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import BCLoss

import torchrl_tsallis as tt
from torchrl_tsallis import data as ttd
from torchrl_tsallis import evaluation as tte
from torchrl_tsallis import modules as ttm
from torchrl_tsallis import trainers as ttt


class Reached(Exception):  # noqa: N818
    """Raised where an argument was accepted and the work would begin."""


class Subject(NamedTuple):
    """What is fuzzed.

    Attributes:
        name: of the constructor or function.
        make: the constructor or function.
        valid: makes arguments by name that are valid.
        kinds: of arguments that the signature does not tell; None leaves one out.
        few: arguments of which a large number would be allowed and take for ever.
    """

    name: str
    make: Callable[..., Any]
    valid: Callable[[], dict[str, Any]]
    kinds: dict[str, Allowed | None] = {}
    few: frozenset[str] = frozenset()

    def arguments(self) -> dict[str, Allowed]:
        """What each argument may be."""
        found: dict[str, Allowed] = {}
        for name, parameter in inspect.signature(self.make).parameters.items():
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                found[name] = kind_of(name, parameter.annotation)
        found |= {name: kind for name, kind in self.kinds.items() if kind is not None}
        return {name: kind for name, kind in found.items() if self.kinds.get(name, kind) is not None}


def rows(size: int = 12) -> TensorDict:
    """Demonstrations of three episodes, with all entries that anything reads."""
    info = {"episode": torch.arange(size) // 4, "expert": torch.zeros(size, dtype=torch.int64)}
    info |= {name: torch.zeros(size, dtype=torch.bool) for name in ("is_noise", "is_amateur")}
    first = torch.arange(size) % 4 == 0
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "observation": torch.randn(size, 3, generator=generator),
            "action": torch.randn(size, 2, generator=generator),
            "is_init": first[:, None],
            "episode": info["episode"].clone(),
            "next": {"observation": torch.randn(size, 3, generator=generator), "done": first.roll(-1, 0)[:, None]},
            "info": info,
        },
        [size],
    )


@cache
def _actor() -> Any:
    return ttm.make_policy(3, 2, hidden=(4,))


@cache
def _recurrent() -> Any:
    return ttm.make_recurrent_policy(3, 2, hidden_size=4, num_layers=1)


def _plain_loss() -> Any:
    actor = TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["action"])
    return BCLoss(actor, loss_function="l2", reduction="none")


def _loss(**settings: Any) -> Any:
    return tt.TsallisBCLoss(_actor(), **settings)


def _peak_loss() -> Any:
    return _loss(rating=tt.PeakRating())


def _trainer() -> dict[str, Any]:
    loss = _loss(gamma_mix=0.0)
    parts = {"loss": loss, "replay_buffer": ttd.make_replay_buffer(rows(), batch_size=4)}
    return {**parts, "optimizer": tt.AdaTerm(loss.parameters()), "steps": 4, "log_every": 2, "progress": False}


class _Env:
    """An environment in which nothing happens, because the run stops before."""

    def reset(self, *args: Any, **kwargs: Any) -> Any:
        raise Reached


def _evaluation() -> dict[str, Any]:
    policies = {"zero": partial(np.zeros_like)}
    return {"policies": policies, "env_fn": _reach, "episodes": 1, "workers": 0, "progress": False}


def _reach(*args: Any, **kwargs: Any) -> Any:
    raise Reached


def _share(name: str) -> Allowed:
    """A number in [0, 1], or one for each stacked member."""
    one = number(name, 0, 1)
    return lambda value: one(value) or bool(np.size(value) and several(one)(value))


_RATING: dict[str, Allowed | None] = {name: _share(name) for name in ("q", "gamma_min", "gamma_max", "beta")}


#: An amateur without hidden layers, as its file holds it.
def _numpy_policy() -> Any:
    return ttd.load_policy("amateur")


def every_subject() -> Iterator[tuple[str, Callable[[], Subject]]]:
    """All of them, made late: a name that a version of the package does not have is left out."""

    def of(name: str, get: Callable[[], Any], valid: Callable[[], dict[str, Any]] = dict, **rest: Any) -> Any:
        return name, lambda: Subject(name, get(), valid, **rest)

    data = {"demonstrations": None}  # fuzzed by fuzz_inputs, where its entries are
    yield of("TsallisRating", lambda: tt.TsallisRating, kinds=_RATING)
    yield of("PeakRating", lambda: tt.PeakRating, kinds={"u": _share("u"), "beta": _share("beta")})
    yield of("TsallisBCLoss", lambda: tt.TsallisBCLoss, lambda: {"actor_network": _actor()}, kinds=_RATING)
    recurrent = lambda: {"actor_network": _recurrent()}  # noqa: E731
    yield of("PredictiveBCLoss", lambda: tt.PredictiveBCLoss, recurrent, kinds=_RATING)
    yield of("RatedLoss", lambda: tt.RatedLoss, lambda: {"loss_module": _plain_loss()})
    yield of("QTuner", lambda: tt.QTuner, lambda: {"loss": _loss()}, kinds={"tuned": lambda v: v is None})
    tuned = {"tuned": lambda v: v is None}
    yield of("ScoreTuner", lambda: tt.ScoreTuner, lambda: {"loss": _peak_loss()}, kinds=tuned)
    yield of("CATSoftUpdate", lambda: tt.CATSoftUpdate, lambda: {"loss_module": _loss()})
    yield of(
        "AdaTerm",
        lambda: tt.AdaTerm,
        lambda: {"params": [nn.Parameter(torch.zeros(2, 3))]},
        kinds={"betas": several(number("beta", 0, 1)), "batch_dims": _dims},
    )
    yield of("make_policy", lambda: ttm.make_policy, lambda: {"obs_dim": 3, "action_dim": 2})
    yield of(
        "make_recurrent_policy",
        lambda: ttm.make_recurrent_policy,
        lambda: {"obs_dim": 3, "action_dim": 2, "hidden_size": 4},
    )
    yield of("NormalHead", lambda: ttm.NormalHead)
    yield of(
        "NoisyLSTM", lambda: ttm.NoisyLSTM, lambda: {"input_size": 3, "hidden_size": 4}, few=frozenset({"num_layers"})
    )
    yield of("RMSNorm", lambda: ttm.RMSNorm, lambda: {"size": 4})
    yield of(
        "Linear",
        lambda: ttm.Linear,
        lambda: {"in_features": 3, "out_features": 2},
        kinds={"bias": flag, "dtype": kind_of("dtype", "torch.dtype | None")},
    )
    yield of(
        "make_replay_buffer",
        lambda: ttd.make_replay_buffer,
        lambda: {"demonstrations": rows(), "batch_size": 4},
        kinds=data,
    )
    sequences = lambda: {"demonstrations": rows(), "slice_len": 4, "num_slices": 2}  # noqa: E731
    yield of("make_sequence_buffer", lambda: ttd.make_sequence_buffer, sequences, kinds=data)
    stacked = lambda: {"demonstrations": rows(), "seeds": [0, 1], "batch_size": 4}  # noqa: E731
    yield of(
        "make_stacked_replay_buffer",
        lambda: ttd.make_stacked_replay_buffer,
        stacked,
        kinds={"demonstrations": anything},
    )
    ranges = lambda: {"seeds": [0, 1], "rows": [range(8), range(8)]}  # noqa: E731
    yield of("MemberSampler", lambda: ttd.MemberSampler.__init__, ranges, kinds={"self": None})
    centres = lambda: {name: {"action": torch.ones(2)} for name in ("centres", "scales")}  # noqa: E731
    yield of("RobustScaling", lambda: ttd.RobustScaling, centres)
    yield of("RobustScaling.fit", lambda: ttd.RobustScaling.fit, lambda: {"demonstrations": rows()}, kinds=data)
    yield of("Scaling", lambda: ttd.Scaling, lambda: {"mean": torch.zeros(3), "std": torch.ones(3), "action_unit": 1.0})
    yield of("Scaling.fit", lambda: ttd.Scaling.fit, lambda: {"demonstrations": rows(), "action_unit": 1.0}, kinds=data)
    one = lambda: {"demonstrations": rows()}  # noqa: E731
    two = lambda: {"experts": rows(), "amateur": rows()}  # noqa: E731
    sides: dict[str, Any] = {"experts": None, "amateur": None, "others": None}
    yield of("add_action_noise", lambda: ttd.add_action_noise, one, kinds=data)
    yield of("replace_with_amateur", lambda: ttd.replace_with_amateur, two, kinds=sides)
    yield of("make_task", lambda: ttd.make_task, lambda: {"task": "both", **two()}, kinds=sides)
    yield of(
        "replace_pairs",
        lambda: ttd.replace_pairs,
        lambda: {"experts": rows(), "others": rows(), "share": 0.5},
        kinds=sides,
    )
    yield of("split_episodes", lambda: ttd.split_episodes, lambda: {**one(), "share": 0.5}, kinds=data)
    yield of("split_trajectories", lambda: ttd.split_trajectories, lambda: {**one(), "share": 0.5}, kinds=data)
    yield of("fold_episodes", lambda: ttd.fold_episodes, lambda: {**one(), "folds": 2}, kinds=data)
    yield of("validate_demonstrations", lambda: ttd.validate_demonstrations, one, kinds=data)
    yield of("inspect_demonstrations", lambda: ttd.inspect_demonstrations, one, kinds=data)
    yield of(
        "record_trajectory",
        lambda: ttd.record_trajectory,
        lambda: {"make_env": _Env, "policy": _numpy_policy(), "std": 0.1, "seed": 0},
        few=frozenset({"tries", "length"}),
    )
    yield of(
        "record_flips",
        lambda: ttd.record_flips,
        lambda: {"make_env": _reach, "seed": 0, "steps": 5},
        few=frozenset({"steps"}),
        kinds={"style": None},
    )
    yield of("FlipOperator", lambda: ttd.FlipOperator, lambda: {"seed": 0}, kinds={"style": None})
    yield of("NumpyPolicy", lambda: ttd.NumpyPolicy, lambda: {"tensors": _tensors()}, kinds={"tensors": named_mapping})
    yield of("load_policy", lambda: ttd.load_policy, lambda: {"path": "amateur"})
    yield of("load_demonstrations", lambda: ttd.load_demonstrations, lambda: {"path": "none"})
    yield of(
        "save_demonstrations",
        lambda: ttd.save_demonstrations,
        lambda: {"path": "x", "demonstrations": rows(), "metadata": {}},
        kinds={**data, "metadata": anything},
    )
    yield of(
        "readers.Options",
        lambda: _module("torchrl_tsallis.data.readers").Options,
        kinds={"observation": _keys, "action": _keys},
    )
    yield of(
        "read_demonstrations",
        lambda: _module("torchrl_tsallis.data.readers").read_demonstrations,
        lambda: {"path": _file()},
        kinds={"observation": _keys, "action": _keys},
    )
    yield of(
        "make_offline_trainer",
        lambda: ttt.make_offline_trainer,
        _trainer,
        kinds={"replay_buffer": named_buffer, "loss": named_loss},
    )
    yield of("EvaluationHook", lambda: ttt.EvaluationHook, lambda: {"evaluate": _reach, "every": 10})
    optimizer = lambda: torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=0.1)  # noqa: E731
    constant = lambda o: torch.optim.lr_scheduler.ConstantLR(o)  # noqa: E731
    yield of("ScheduleHook", lambda: ttt.ScheduleHook, lambda: {"make": constant, "optimizer": optimizer()})
    yield of("GuardedStepper", lambda: ttt.GuardedStepper)
    yield of("OfflineClock", lambda: ttt.OfflineClock, lambda: {"steps": 3})
    yield of(
        "SampleHook",
        lambda: ttt.SampleHook,
        lambda: {"replay_buffer": ttd.make_replay_buffer(rows(), batch_size=4)},
        kinds={"replay_buffer": named_buffer},
    )
    yield of(
        "LoggerGroup",
        lambda: ttt.LoggerGroup.__init__,
        lambda: {"loggers": [_csv()]},
        kinds={"self": None, "loggers": lambda v: False},
    )
    yield of(
        "make_logger",
        lambda: ttt.make_logger,
        lambda: {"kind": "csv", "folder": "logs", "name": "a"},
        kinds={"kind": lambda v: v == "csv", "tags": _keys},
    )
    yield of("keep_freed_memory", lambda: ttt.keep_freed_memory)
    yield of(
        "evaluate_policies",
        lambda: tte.evaluate_policies,
        _evaluation,
        few=frozenset({"episodes", "workers"}),
        kinds={"policies": anything, "env_fn": _env_fn},
    )
    rollout = lambda: {"policy": partial(np.zeros_like), "path": "x.gif", "env_fn": _reach}  # noqa: E731
    yield of(
        "record_rollout",
        lambda: tte.record_rollout,
        rollout,
        few=frozenset({"seconds", "fps"}),
        kinds={"policy": callable, "env_fn": _env_fn},
    )
    yield of("ActorPolicy", lambda: tte.ActorPolicy, lambda: {"actor": _actor()}, kinds={"actor": lambda v: False})
    yield of(
        "MeanPolicy",
        lambda: tte.MeanPolicy,
        lambda: {"layers": [(np.ones((4, 3)), np.zeros(4), None)]},
        kinds={"layers": lambda v: False},
    )
    yield of(
        "RecurrentMeanPolicy",
        lambda: tte.RecurrentMeanPolicy,
        _recurrent_parts,
        kinds=dict.fromkeys(("layers", "head", "mean", "std"), anything),
    )
    scores = lambda: {"scores": [1.0, 2.0, 3.0], "resamples": 20}  # noqa: E731
    yield of(
        "bootstrap_interval",
        lambda: tte.bootstrap_interval,
        scores,
        few=frozenset({"resamples"}),
        kinds={"statistic": anything, "scores": _floats},
    )
    pair = lambda: {"x": [1.0, 2.0], "y": [0.0, 3.0], "resamples": 20}  # noqa: E731
    yield of(
        "improvement_interval",
        lambda: tte.improvement_interval,
        pair,
        few=frozenset({"resamples"}),
        kinds={"x": _floats, "y": _floats},
    )
    yield of(
        "probability_of_improvement",
        lambda: tte.probability_of_improvement,
        lambda: {"x": [1.0, 2.0], "y": [0.0, 3.0]},
        kinds={"x": _floats, "y": _floats},
    )
    yield of("iqm", lambda: tte.iqm, lambda: {"values": [1.0, 2.0]}, kinds={"values": _floats})
    yield of("median", lambda: tte.median, lambda: {"values": [1.0, 2.0]}, kinds={"values": _floats})
    yield of(
        "auroc",
        lambda: tte.auroc,
        lambda: {"positive": [1.0, 2.0], "negative": [0.0]},
        kinds={"positive": _floats, "negative": _floats},
    )
    yield of(
        "count_flips",
        lambda: _module("torchrl_tsallis.envs").count_flips,
        lambda: {"angles": np.zeros((20, 3))},
        kinds={"angles": anything},
    )


def _dims(value: Any) -> bool:
    """Whether there are members is a number of dimensions too."""
    return flag(value) or whole("batch_dims")(value)


def _module(name: str) -> Any:
    return __import__(name, fromlist=["_"])


def named_mapping(value: Any) -> bool:
    """No mapping of the pool holds a policy."""
    return False


def named_buffer(value: Any) -> bool:
    """Nothing of the pool is a buffer."""
    return False


def named_loss(value: Any) -> bool:
    """Nothing of the pool is a loss."""
    return False


def _floats(value: Any) -> bool:
    """Whether these are numbers, at least one and none NaN."""
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return False
    return found.size > 0 and not bool(np.isnan(found).any()) and not isinstance(value, (str, bytes))


def _keys(value: Any) -> bool:
    """Strings, one or several."""
    many = [] if value is None else [value] if isinstance(value, str) else value
    return isinstance(many, (list, tuple)) and all(isinstance(one, str) for one in many)


def _env_fn(value: Any) -> bool:
    return callable(value) or isinstance(value, str)


def _file() -> str:
    ends = np.array([False, False, True, True])
    np.savez("demonstrations.npz", observations=np.zeros((4, 3)), actions=np.zeros((4, 2)), terminals=ends)
    return "demonstrations.npz"


def _csv() -> Any:
    from torchrl.record.loggers.csv import CSVLogger

    return CSVLogger("a", "logs")


def _tensors() -> dict[str, np.ndarray]:
    return dict(_numpy_policy().tensors)


def _recurrent_parts() -> dict[str, Any]:
    layer = (np.ones((16, 3)), np.ones((16, 4)), np.zeros(16))
    head = (np.ones((4, 4)), np.zeros(4))
    return {"layers": [layer], "head": head, "mean": np.zeros(3), "std": np.ones(3), "action_unit": 1.0}


def subjects() -> list[Subject]:
    """Those that this version of the package has."""
    found = []
    for _, make in every_subject():
        try:
            found.append(make())
        except (AttributeError, ImportError):
            continue
    return found


__all__ = ["Reached", "Subject", "key", "rows", "subjects"]
