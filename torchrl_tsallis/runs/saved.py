"""What is written of a policy, so that its folder can act and rate again, and what is read of it."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import tensordict
import torch
import torchrl
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.jobs.files import atomic_path
from torchrl_tsallis.ratings.base import Rating
from torchrl_tsallis.runs.folder import FORMAT, RUN, read_json, write_json
from torchrl_tsallis.version import __version__

#: The factory of the policies that a run can be opened with.
FACTORY = "torchrl_tsallis.modules.make_policy"
#: What ``run.json`` has to say, with its types.
_NEEDED: dict[tuple[str, ...], type | tuple[type, ...]] = {
    ("kind",): str,
    ("method", "rating"): str,
    ("policy", "factory"): str,
    ("policy", "arguments", "obs_dim"): int,
    ("policy", "arguments", "action_dim"): int,
    ("data", "format"): str,
    ("data", "keys", "observation"): list,
    ("data", "keys", "action"): list,
}


def versions() -> dict[str, str]:
    """Versions of what computed a run."""
    modules = (torch, torchrl, tensordict, np, safetensors)
    own = {"torchrl_tsallis": __version__, "python": platform.python_version()}
    return own | {module.__name__: module.__version__ for module in modules}


def save_tensors(path: Path, state: Mapping[str, Tensor]) -> None:
    """Writes tensors as safetensors, whole or not at all."""
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in state.items()}, temporary)


def load_tensors(path: Path) -> dict[str, Tensor]:
    """Reads what :func:`save_tensors` wrote.

    Raises:
        FileNotFoundError: if it is not there.
        OSError: if it cannot be read.
        ValueError: if it is broken.
    """
    try:
        return load_file(path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{str(path)!r} is not there: the run is not complete, make it again") from error
    except OSError as error:
        raise OSError(error.errno, f"cannot read {str(path)!r} ({error.strerror}): check its permissions") from error
    except SafetensorError as error:
        raise ValueError(f"{str(path)!r} is broken ({error}): make the run again") from error


def make_rating(method: Mapping[str, Any]) -> Rating:
    """The rating that ``method`` of ``run.json`` describes; its running statistics are at their start.

    Raises:
        ValueError: if it is none that is known; a module of one's own has to be imported first.
    """
    settings = dict(method)
    kind = Rating.known.get(str(settings.pop("rating", None)))
    if kind is None:
        raise ValueError(
            f"the rating {method.get('rating')!r} of {RUN} is not known here, only {', '.join(sorted(Rating.known))}: "
            "import the module of its class first"
        )
    try:
        return kind.from_settings(settings)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"the method {dict(method)} of {RUN} describes no rating ({error})") from error


def save_run(
    folder: str | os.PathLike[str],
    *,
    kind: str,
    actor: Mapping[str, Tensor],
    rating: Mapping[str, Tensor],
    rating_class: type[Rating],
    arguments: Mapping[str, Any],
    data: Mapping[str, Any],
    train: Mapping[str, Any],
    command: str,
    scaling: RobustScaling | None = None,
    target: Mapping[str, Tensor] | None = None,
) -> dict[str, Any]:
    """Writes what :class:`~torchrl_tsallis.runs.Run` opens: rating, scaling, ``run.json``, and last the policy.

    Args:
        folder: of the run; other files in it stay.
        kind: ``"ratings"``, ``"policy"`` or ``"recipe"``.
        actor: state of an actor of :func:`~torchrl_tsallis.modules.make_policy`.
        rating: state of its rating, of one policy.
        rating_class: its class.
        arguments: of ``make_policy``.
        data: ``format`` and ``keys`` of what it was trained on, and whatever else identifies it.
        train: numbers of the training.
        command: that made it.
        scaling: of observation and action. Default: None, the policy takes both as they are.
        target: state of the target network's actor, where the rating has one.

    Returns:
        What ``run.json`` says.

    Raises:
        OSError: if a file cannot be written.
        ValueError: if the rating cannot be made again from its state.
    """
    place = Path(folder)
    method = {"rating": rating_class.saved_as, **rating_class.settings_of(rating)}
    try:
        make_rating(method)
    except ValueError as error:
        raise ValueError(
            f"a {rating_class.__name__} cannot be made again from {method}, so that its run could not be opened: give "
            "it settings_of and from_settings"
        ) from error
    save_tensors(place / "rating.safetensors", rating)
    if target is not None:
        save_tensors(place / "target.safetensors", target)
    write_json(place / "scaling.json", {} if scaling is None else scaling.to_json())
    settings = {
        "format": FORMAT,
        "kind": kind,
        "method": method,
        "policy": {"factory": FACTORY, "arguments": dict(arguments)},
        "data": dict(data),
        "train": dict(train),
        "versions": versions(),
        "command": command,
    }
    write_json(place / RUN, settings)
    save_tensors(place / "policy.safetensors", actor)  # last: recipes take it for the mark of a finished training
    return settings


def read_settings(folder: Path) -> dict[str, Any]:
    """Reads and checks ``run.json``.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is of another format, or does not say what it has to.
    """
    file = folder / RUN
    settings = read_json(file)
    form, made = settings.get("format"), settings.get("versions")
    if isinstance(form, int) and form > FORMAT:
        by = made.get("torchrl_tsallis", "a later version") if isinstance(made, dict) else "a later version"
        raise ValueError(
            f"{str(file)!r} has the format {form}, written by torchrl_tsallis {by}; this is {__version__}, which reads "
            f"{FORMAT}: pip install -U torchrl-tsallis"
        )
    if form != FORMAT:
        raise ValueError(f"{str(file)!r} has the format {form!r}, this version reads {FORMAT}: make the run again")
    for path, kind in _NEEDED.items():
        value: Any = settings
        for name in path:
            value = value.get(name) if isinstance(value, dict) else None
        if not isinstance(value, kind) or isinstance(value, bool):
            raise ValueError(f"{str(file)!r} does not say {'.'.join(path)!r}: make the run again")
    if settings["policy"]["factory"] != FACTORY:
        raise ValueError(f"{str(file)!r} has a policy of {settings['policy']['factory']!r}, which is not known here")
    return settings


def read_scaling(folder: Path, arguments: Mapping[str, int]) -> RobustScaling:
    """Reads ``scaling.json``; what it does not name is not scaled.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is broken, or of other dimensions than the policy.
    """
    file = folder / "scaling.json"
    state = read_json(file)
    dims = {"observation": arguments["obs_dim"], "action": arguments["action_dim"]}
    try:
        found = RobustScaling.from_json(state)
        wrong = [key for key, value in found.centres.items() if value.shape != (dims[str(key)],)]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{str(file)!r} is no scaling ({error}): make the run again") from error
    if wrong or (state and len(found.centres) < len(dims)):
        raise ValueError(f"{str(file)!r} does not scale the policy's {dims} dimensions: make the run again")
    if state:
        return found
    return RobustScaling(*({key: fill(dim) for key, dim in dims.items()} for fill in (torch.zeros, torch.ones)))
