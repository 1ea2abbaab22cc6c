"""The settings of a training: kept in its checkpoints, compared when it is resumed, taken as the caller says."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import torch
from torch import nn
from torchrl.trainers import Trainer

from torchrl_tsallis._torchrl import registered_modules

#: Whose settings hold: the checkpoint's, the new trainer's, or neither if they differ.
Settings = Literal["refuse", "checkpoint", "new"]
_LONGEST = 1000  # entries of a list that is still a setting, and no data
#: Public attributes that are no settings: they change as a training goes on, or a batch is drawn.
_STATES = {"training", "len_storage", "skipped", "in_a_row", "best", "without_best", "initialized", "last_epoch"}
_LOADED = ("optimizer", "lr_schedule")  # the parts whose settings come along with the checkpoint's state


def _plain(value: Any) -> bool:
    """Whether a value is a number, a text, or a short list of them."""
    if isinstance(value, (list, tuple)):
        return len(value) <= _LONGEST and all(map(_plain, value))
    return value is None or isinstance(value, (bool, int, float, str))


def _public(owner: Any) -> dict[str, Any]:
    """The plain public attributes of an object."""
    own = getattr(owner, "__dict__", {})
    return {k: v for k, v in own.items() if not k.startswith("_") and k not in _STATES and _plain(v)}


def _groups(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """The options of an optimizer's groups; with their number where there are several."""
    many = len(optimizer.param_groups) > 1
    found = {}
    for number, group in enumerate(optimizer.param_groups):
        for key, value in group.items():
            value = value.tolist() if isinstance(value, torch.Tensor) else value
            if key != "params" and _plain(value):
                found[f"{number}.{key}" if many else key] = value
    return found


def _parts(trainer: Trainer) -> Iterator[tuple[str, Any]]:
    """The objects that have settings."""
    loss = trainer.loss_module
    yield "loss", loss
    for name, child in loss.named_children():
        if not name.endswith("_params"):
            yield f"loss.{name}", child
    yield "updater", trainer.target_net_updater
    yield "optimizer", trainer.optimizer
    for name, module in registered_modules(trainer).items():
        yield name, module
        buffer = getattr(module, "replay_buffer", None)
        if buffer is not None:
            yield "buffer", buffer
            yield f"{name}.sampler", getattr(buffer, "sampler", None)
        for attribute in ("optimizer", "schedule"):
            inner = getattr(module, attribute, None)
            if inner is not None and inner is not trainer.optimizer:
                yield f"{name}.{attribute}", inner


def settings_of(trainer: Trainer) -> dict[str, Any]:
    """What a training was made with: the class and the plain public attributes of everything that takes part in it.

    Args:
        trainer: that has not begun.

    Returns:
        By name, as JSON would give it back; ``optimizer.lr`` for one.
    """
    found: dict[str, Any] = {"trainer.clip_norm": trainer.clip_norm, "trainer.log_every": trainer.collector.steps}
    tuned = {getattr(module, "setting", None) for module in registered_modules(trainer).values()}
    for name, part in _parts(trainer):
        if part is None:
            continue
        found[f"{name}.class"] = type(part).__name__
        own = _groups(part) if isinstance(part, torch.optim.Optimizer) else _public(part)
        if name == "buffer":
            own["batch_size"] = getattr(part, "batch_size", None)
        if isinstance(part, nn.Module):
            rated = getattr(part, "rating_module", part)  # a rating's settings are its own buffers
            buffers = {key: value.tolist() for key, value in rated.named_buffers(recurse=False)}
            own |= {key: value for key, value in buffers.items() if key not in tuned}  # what is tuned is a state
        found |= {f"{name}.{key}": value for key, value in own.items()}
    return json.loads(json.dumps(found))


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The settings that differ, with both values; an option that only one version of the package has is none."""
    missing = "not there"
    names = [name for name in {**before, **now} if name.endswith(".class") or (name in before and name in now)]
    both = {name: (before.get(name, missing), now.get(name, missing)) for name in names}
    return {name: pair for name, pair in both.items() if json.dumps(pair[0]) != json.dumps(pair[1])}


def check_changes(changed: Mapping[str, tuple[Any, Any]], settings: Settings, path: str) -> None:
    """Refuses changed settings that the caller did not choose between, or that cannot be taken.

    Args:
        changed: of :func:`changes`.
        settings: whose settings are to hold.
        path: of the checkpoint.

    Raises:
        ValueError: if settings changed and none may; the message names them and the way out.
    """
    told = ", ".join(f"{name} was {old!r} and is {new!r}" for name, (old, new) in changed.items())
    gone = "not there"
    fixed = [name for name, pair in changed.items() if name.endswith(".class") and gone not in pair]
    loaded = [name for name in changed if any(part in name.split(".") for part in _LOADED) and name not in fixed]
    if settings == "refuse" and changed:
        raise ValueError(
            f"{path!r} was made with other settings: {told}; make the trainer with the ones of before, or choose: "
            "resume(trainer, settings='checkpoint') keeps those of the checkpoint, settings='new' takes the new ones"
        )
    if fixed:
        raise ValueError(
            f"{path!r} was made with other objects: {told}; the state of one does not fit another: make the trainer "
            "with those of before, or begin in another folder"
        )
    left = [name for name in changed if name not in loaded and not name.startswith(("loss.q", "loss.rating_module."))]
    if settings == "checkpoint" and left:
        raise ValueError(
            f"{path!r} cannot give back all of its settings ({told}): those of {', '.join(left)} are of objects "
            "that are made already, make the trainer with the ones of before"
        )


def take_new(trainer: Trainer, changed: Mapping[str, tuple[Any, Any]]) -> None:
    """Puts the new settings back that the state of a checkpoint has just replaced.

    Args:
        trainer: after the checkpoint was loaded.
        changed: of :func:`changes`.
    """
    for name, part in _parts(trainer):
        new = {key.removeprefix(f"{name}."): pair[1] for key, pair in changed.items() if key.startswith(f"{name}.")}
        if isinstance(part, torch.optim.Optimizer):
            many = len(part.param_groups) > 1
            for number, group in enumerate(part.param_groups):
                for key, old in group.items():
                    value = new.get(f"{number}.{key}" if many else key)
                    if value is None:
                        continue
                    if isinstance(old, torch.Tensor):
                        old.copy_(torch.as_tensor(value))
                    else:
                        group[key] = tuple(value) if isinstance(old, tuple) else value
        elif isinstance(part, nn.Module):
            for key, buffer in part.named_buffers(recurse=False):
                if key in new:
                    buffer.copy_(torch.as_tensor(new[key]))
    for module in registered_modules(trainer).values():
        if hasattr(module, "replay") and any(name.startswith(("optimizer.", "lr_schedule.")) for name in changed):
            module.replay(module.schedule.last_epoch)
