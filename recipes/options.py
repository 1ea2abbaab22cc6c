"""Checks of a recipe's options, in the main process and before anything is made: one line that names the option."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from common import as_list, make_rating, make_trainer
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.data import ReplayBuffer

from torchrl_tsallis._checks import check_choice, check_flag, check_number, check_path, check_seed, check_text

Check = Callable[[str, Any], Any]
_FAULTS = (TypeError, ValueError, KeyError, AttributeError, OmegaConfBaseException)

#: Any whole number up to here can be waited for, and counted.
MOST = 10**9
count: Check = partial(check_number, low=1, high=MOST, integer=True)
whole: Check = partial(check_number, low=0, high=MOST, integer=True)
share: Check = partial(check_number, low=0, high=1)
size: Check = partial(check_number, low=0, high=1e9)
positive: Check = partial(check_number, above=0, high=1e9)


def one_seed(name: str, value: Any) -> None:
    """Seeds of which others are made by sums and products."""
    check_number(name, check_seed(name, value, low=0), high=10**12, integer=True)


def optional(one: Check) -> Check:
    """None, or what another check takes."""
    return lambda name, value: None if value is None else one(name, value)


def listed(one: Check, least: int = 1) -> Check:
    """One value or a list of at least so many."""

    def check(name: str, value: Any) -> None:
        values = as_list(value)
        if len(values) < least:
            raise ValueError(f"{name} must be a list of at least {least}, got {value!r}")
        for part in values:
            one(name, part)

    return check


def by_name(one: Check) -> Check:
    """A mapping of names to what another check takes."""

    def check(name: str, value: Any) -> None:
        if not isinstance(value, (DictConfig, Mapping)) or not value:
            raise TypeError(f"{name} must be a mapping of names, such as {{name: ...}}, got {value!r}")
        for key, part in value.items():
            one(f"{name}.{key}", part)

    return check


def choice(*names: str) -> Check:
    """One of some names."""
    return lambda name, value: check_choice(name, value, names)


def seeds(name: str, value: Any) -> None:
    """How many, or a list of them."""
    if isinstance(value, (list, ListConfig)):
        listed(one_seed)(name, value)
    else:
        check_number(name, value, low=1, high=100_000, integer=True)


def device(name: str, value: Any) -> None:
    """A device of torch, such as cuda:0."""
    try:
        torch.device(check_text(name, value))
    except RuntimeError as error:
        raise ValueError(f"{name} must be a device of torch, such as cpu or cuda:0, got {value!r}") from error


#: What each option may be, by its place. A recipe's own come on top.
OPTIONS: dict[str, Check] = {
    "output": check_path, "pictures": check_path, "results": check_path, "known": optional(check_path),
    "whole": check_path, "flips": optional(check_path), "human": optional(by_name(check_path)),
    "paper": optional(listed(check_text)),
    "progress": check_flag, "resume": check_flag, "video": check_flag, "replay": check_flag,
    "workers": partial(check_number, low=0, high=10_000, integer=True),
    "log": choice("csv", "tensorboard", "wandb"), "mode": choice("run", "report"),
    "launcher": choice("local", "ray"), "device": device, "block": count,
    "compile": lambda name, value: value is None or by_name(lambda *_: None)(name, value or {"none": 0}),
    "ray.address": optional(check_text), "ray.num_cpus": size, "ray.num_gpus": size,
    "seed": listed(one_seed), "seeds": seeds, "q": share, "std": listed(size), "clip": check_flag,
    "task": listed(check_text), "method": listed(check_text), "part": optional(listed(check_text)),
    "tasks": listed(check_text), "stds": listed(size), "folds": partial(check_number, low=2, high=MOST, integer=True),
    "trios": by_name(listed(check_text, 2)),
    "epochs": count, "batch_size": count, "checkpoint_every": count, "validate_every": count,
    "slice_len": count, "num_slices": count, "steps": optional(count), "trajectories": count, "show": optional(whole),
    "evaluation.episodes": count, "evaluation.seed": one_seed, "trials.count": count, "trials.seed": one_seed,
    "data.std": size, "data.clip": check_flag, "data.seed": one_seed, "data.length": count, "data.cache": check_path,
    "data.policies": listed(check_text, 2), "data.learners": listed(check_text),
    "data.noise.probability": share, "data.noise.mean": partial(check_number, low=-1e9, high=1e9),
    "data.noise.scale": size, "data.trajectories": partial(check_number, low=2, high=MOST, integer=True),
    "data.steps": count, "data.action_unit": positive,
    "data.validation": partial(check_number, above=0, below=1),
}  # fmt: skip


@contextmanager
def named(name: str) -> Iterator[None]:
    """Turns what is raised for an option into one line, and the end of the program."""
    try:
        yield
    except Exception as error:
        root: BaseException = error
        while isinstance(root, InstantiationException) and root.__cause__ is not None:
            root = root.__cause__
        known = isinstance(root, _FAULTS)
        text = " ".join(str(root.args[0] if isinstance(root, KeyError) and root.args else root).split())
        if not known:
            raise
        raise SystemExit(f"{name}: {text}"[:500]) from error


def check_options(cfg: DictConfig, own: Mapping[str, Check] | None = None) -> None:
    """Checks every option by its kind.

    Args:
        cfg: of the recipe.
        own: options of the recipe alone, or of another kind than in other recipes.

    Raises:
        SystemExit: for the first option that is none; one line names it, what it may be, and what it is.
    """
    for name, check in (OPTIONS | dict(own or {})).items():
        *groups, leaf = name.split(".")
        place: Any = cfg
        for depth, group in enumerate(groups):
            if not isinstance(place, DictConfig) or group not in place:
                place = None
                break
            with named(name):
                place = place[group]
                if not isinstance(place, DictConfig):
                    where = ".".join(groups[: depth + 1])
                    raise TypeError(f"{where} must be a mapping of options such as {name}, got {place!r}")
        if place is not None and leaf in place:
            with named(name):
                check(name, place[leaf])


def check_parts(cfg: DictConfig) -> None:
    """Builds what each method is trained with, for data of two dimensions, so that its settings are checked.

    Args:
        cfg: of the recipe.

    Raises:
        SystemExit: for a setting that does not fit; one line names the group and the setting.
    """
    for group in ("methods", "ratings", "tuners", "policy", "loss", "updater", "optimizer", "trainer"):
        if not isinstance(cfg[group], DictConfig):
            raise SystemExit(f"{group}: must be a mapping of settings, got {cfg[group]!r}")
    state = torch.get_rng_state()
    with named("policy"):
        policy = instantiate(cfg.policy, obs_dim=2, action_dim=2)
    for name in cfg.methods:
        place = f"methods.{name}"
        with named(place):
            method = cfg.methods[name]
            if not isinstance(method, DictConfig) or not {"rating", "tuned"} <= set(method):
                raise TypeError(f"a method must be a mapping with rating and tuned, got {method!r}")
            check_choice("rating", method.rating, list(cfg.ratings))
            check_flag("tuned", method.tuned)
            rating, tuner = make_rating(cfg, method)
        with named("loss"):
            loss = instantiate(cfg.loss, _partial_=True)(actor_network=policy, rating=rating)
        for part in ("updater", "optimizer"):
            with named(part):
                made = instantiate(cfg[part])
                _ = made(loss) if part == "updater" else made(loss.parameters())
        with named(f"tuners.{method.rating}, {place}"):
            _ = None if tuner is None else tuner(loss)
        with tempfile.TemporaryDirectory() as folder, named("trainer"):
            make_trainer(cfg, loss, ReplayBuffer(), epoch=1, tuner=tuner, logger=None, folder=Path(folder))
    torch.set_rng_state(state)


def check_grids(cfg: DictConfig) -> None:
    """Checks the grids of recipes/ant_regimes.py."""
    columns: dict[str, Check] = {"trio": listed(check_text), "task": listed(check_text), "method": listed(check_text)}
    columns |= {"std": listed(size), "scale": listed(positive)}

    def grid(name: str, value: Any) -> None:
        if not isinstance(value, DictConfig) or set(columns) - set(value):
            raise TypeError(f"{name} must be a mapping of {', '.join(columns)}, got {value!r}")
        for column, check in columns.items():
            check(f"{name}.{column}", value[column])
        unknown = [trio for trio in as_list(value.trio) if trio not in cfg.trios]
        if unknown:
            raise ValueError(f"{name}.trio must be one of {', '.join(cfg.trios)}, got {unknown[0]!r}")

    with named("grids"):
        by_name(grid)("grids", cfg.grids)


def resolved(cfg: DictConfig) -> None:
    """Raises SystemExit where an option refers to one that is not there."""
    with named("the configuration"):
        OmegaConf.to_container(cfg, resolve=True)
