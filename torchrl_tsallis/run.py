"""From a file of demonstrations to ratings and a policy: :func:`rate`, :func:`train`, and what they leave.

Importing the command line, a report or any format's library is not needed for it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torchrl.record.loggers.common import Logger

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.hygiene import inspect_demonstrations
from torchrl_tsallis.data.signals import episode_signals
from torchrl_tsallis.jobs.files import atomic_path
from torchrl_tsallis.runs.card import model_card
from torchrl_tsallis.runs.folder import check_free, new_folder, write_json
from torchrl_tsallis.runs.held_out import hold_out
from torchrl_tsallis.runs.judgement import judge
from torchrl_tsallis.runs.members import LR, Members, Split, default_steps, make_splits, train_members
from torchrl_tsallis.runs.modes import mode_source, modes
from torchrl_tsallis.runs.opened import Run
from torchrl_tsallis.runs.saved import save_run
from torchrl_tsallis.runs.source import Source, load_source
from torchrl_tsallis.runs.tables import write_tables

__all__ = ["Run", "default_steps", "modes", "rate", "train"]


def rate(
    path_or_data: str | os.PathLike[str] | TensorDictBase,
    out: str | os.PathLike[str],
    *,
    obs: str | Sequence[str] | None = None,
    action: str | Sequence[str] | None = None,
    episode: str | None = None,
    format: str | None = None,
    filter_key: str | None = None,
    steps: int | None = None,
    seeds: int = 3,
    folds: int = 2,
    batch_size: int = 256,
    device: str = "cpu",
    progress: bool = True,
    overwrite: bool = False,
    command: str = "",
    logger: Logger | None = None,
) -> Run:
    r"""Rates demonstrations by policies that saw them and by policies that did not.

    Each seed deals the episodes into folds of its own, and a policy a fold is trained on the other folds; one more is
    trained on everything and is kept. All of them are stacked members of one program: the robust scaling of their own
    training rows, behavioral cloning with :class:`~torchrl_tsallis.PeakRating` and its tuner, and AdaTerm. An episode's
    surprise is that of the policies that did not see it,

    .. math:: -\log_{10} P(\chi^2_A \ge Z / t)

    with the squared distance Z of A dimensions, and with t, by which typical distances on held-out episodes exceed a
    normal's (at least 1, one a policy). The output is a queue for review: what is unlikely in its state comes first, be
    it bad or good, and faults that many episodes share are not found. The same in other units up to rounding.

    Args:
        path_or_data: what :func:`~torchrl_tsallis.data.readers.read_demonstrations` reads, or demonstrations ``[N]``.
        out: folder of the run, which is written whole or not at all.
        obs: keys of the observation in the file. Default: what the format calls so.
        action: key of the action in the file. Default: what the format calls so.
        episode: key of the episode's number (npz, CSV).
        format: name of the format. Default: found by looking.
        filter_key: subset of the file's episodes.
        steps: gradient steps. Default: :func:`default_steps`.
        seeds: replications, which the intervals are over; at least 2 for a verdict.
        folds: parts of which one is held out at a time.
        batch_size: samples a step and policy; less where a policy has fewer rows.
        device: of the policies.
        progress: whether to show a bar.
        overwrite: whether an earlier run in ``out`` is replaced, once this one is done.
        command: what ``run.json`` says that it was made by. Default: this function.
        logger: any of TorchRL's, or what :func:`~torchrl_tsallis.trainers.make_logger` makes: W&B and TensorBoard get
            the episodes as a table and the surprise of the steps as a histogram, once the folder is written. Default:
            None.

    Returns:
        The run, opened from its folder.

    Raises:
        FileExistsError: if ``out`` holds something.
        OSError: if something cannot be read or written.
        KeyError: if a key is missing.
        TypeError: if ``logger`` is something else.
        ValueError: if data or a number cannot be used; the message says what to do.

    Examples:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> rows = {"observation": torch.rand(80, 2), "action": torch.rand(80, 1), "episode": torch.arange(80) // 8}
        >>> folder = Path(tempfile.mkdtemp()) / "ratings"
        >>> run = rate(TensorDict(rows, [80]), folder, steps=10, seeds=2, progress=False)
        >>> len(run.episodes), run.rate(TensorDict(rows, [80])).shape
        (10, torch.Size([80]))
    """
    for name, value, low in (("seeds", seeds, 1), ("folds", folds, 2), ("batch_size", batch_size, 1)):
        check_number(name, value, low=low, integer=True)
    if logger is not None and not isinstance(logger, Logger):
        raise TypeError(f"logger must be one of TorchRL's, as make_logger makes them, got {shown(logger)}")
    check_device(device)
    _check_place(path_or_data, out, overwrite)
    source = load_source(path_or_data, obs=obs, action=action, episode=episode, format=format, filter_key=filter_key)
    data, episodes = source.data, source.episodes()
    steps = _steps(steps, len(data), batch_size)
    splits = make_splits(data, seeds=seeds, folds=folds)
    with new_folder(out, overwrite=overwrite) as folder:
        everything = Split(0, torch.zeros(len(data), dtype=torch.bool))
        members = train_members(
            data, [*splits, everything], steps=steps, batch_size=batch_size, device=device, progress=progress
        )
        found = hold_out(members, data, splits, seeds)
        by_seed = found.by_episode(episodes).numpy()
        findings = [finding.to_json() for finding in inspect_demonstrations(data)]
        numbers = {"steps": steps, "batch_size": batch_size, "seeds": seeds, "folds": folds, "lr": LR}
        summary = judge(source.names, by_seed, found.surprise.numpy(), found.rating.numpy(), found.stretch)
        u = members.loss.rating_module.get_buffer("u").tolist()
        _write_policy(folder, members, len(splits), source, "ratings", numbers, command or "torchrl_tsallis.run.rate")
        write_tables(folder, source, episodes, found, by_seed, episode_signals(data))
        write_json(folder / "summary.json", summary | {"u": u, "findings": findings})
    if logger is not None:
        from torchrl_tsallis.report.log import log_ratings

        log_ratings(out, logger)
    return Run.open(out)


def train(
    path_or_data: str | os.PathLike[str] | TensorDictBase,
    out: str | os.PathLike[str],
    *,
    obs: str | Sequence[str] | None = None,
    action: str | Sequence[str] | None = None,
    episode: str | None = None,
    format: str | None = None,
    filter_key: str | None = None,
    mode: int | Literal["each"] | None = None,
    steps: int | None = None,
    seed: int = 0,
    batch_size: int = 256,
    device: str = "cpu",
    progress: bool = True,
    overwrite: bool = False,
    command: str = "",
) -> Run:
    """Trains a policy on all of the demonstrations, as that of :func:`rate` which is kept.

    Episodes are not needed. The folder has no tables and no verdict; it can act, and rate other data.

    Args:
        path_or_data: as for :func:`rate`, and so are all others.
        out: folder of the run.
        obs: keys of the observation in the file.
        action: key of the action in the file.
        episode: key of the episode's number (npz, CSV).
        format: name of the format.
        filter_key: subset of the file's episodes.
        mode: of the folder ``path_or_data`` that :func:`modes` left, whose episodes alone are imitated; ``each`` for
            one policy of all episodes whose observation goes on with the mode, as a 1 among zeros.
        steps: gradient steps. Default: :func:`default_steps`.
        seed: of the first parameters and of the samples' order.
        batch_size: samples a step.
        device: of the policy.
        progress: whether to show a bar.
        overwrite: whether an earlier run in ``out`` is replaced.
        command: what ``run.json`` says that it was made by.

    Returns:
        The run, opened from its folder.

    Raises:
        FileExistsError: as for :func:`rate`, and so are all others.
    """
    check_number("batch_size", batch_size, low=1, integer=True)
    check_number("seed", seed, low=0, integer=True)
    check_device(device)
    _check_place(path_or_data, out, overwrite)
    chosen = {"obs": obs, "action": action, "episode": episode, "format": format, "filter_key": filter_key}
    if mode is None:
        source = load_source(path_or_data, **chosen)  # type: ignore[arg-type]
    else:
        given = [name for name, value in chosen.items() if value is not None]
        if given or isinstance(path_or_data, TensorDictBase):
            raise ValueError("mode is one of a folder of modes, which says what to read: give that folder, and no keys")
        source = mode_source(path_or_data, mode)
    steps = _steps(steps, len(source.data), batch_size)
    split = Split(seed, torch.zeros(len(source.data), dtype=torch.bool))
    with new_folder(out, overwrite=overwrite) as folder:
        members = train_members(
            source.data, [split], steps=steps, batch_size=batch_size, device=device, progress=progress
        )
        numbers = {"steps": steps, "batch_size": batch_size, "seed": seed, "lr": LR}
        settings = _write_policy(folder, members, 0, source, "policy", numbers, command or "torchrl_tsallis.run.train")
        with atomic_path(folder / "README.md") as card:
            card.write_text(model_card(settings, os.fspath(out)), encoding="utf-8")
    return Run.open(out)


def _steps(steps: int | None, rows: int, batch_size: int) -> int:
    given = default_steps(rows, batch_size) if steps is None else steps
    return int(check_number("steps", given, low=1, integer=True))


def _check_place(
    path_or_data: str | os.PathLike[str] | TensorDictBase, out: str | os.PathLike[str], overwrite: bool
) -> None:
    check_free(out, overwrite, path_or_data if isinstance(path_or_data, (str, os.PathLike)) else None)


def _write_policy(
    folder: Path, members: Members, member: int, source: Source, kind: str, numbers: dict[str, Any], command: str
) -> dict[str, Any]:
    obs_dim, action_dim = source.dims
    return save_run(
        folder,
        kind=kind,
        actor=members.actor_state(member),
        rating=members.rating_state(member),
        rating_class=type(members.loss.rating_module),
        arguments={"obs_dim": obs_dim, "action_dim": action_dim},
        data=source.to_json(),
        train=numbers,
        command=command,
        scaling=members.scalings[member],
    )
