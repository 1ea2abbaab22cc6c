"""From a rating to a copy of the data without what the user decided to drop."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl_tsallis.data.curators import CURATORS, Plan
from torchrl_tsallis.data.curators.choice import decide
from torchrl_tsallis.data.curators.place import RECORD, check_place, leftovers, record_of, staged
from torchrl_tsallis.data.modes_folder import ModesFolder
from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.data.readers import Options, Reader, open_reader
from torchrl_tsallis.jobs.files import atomic_path


@dataclass(frozen=True)
class Curated:
    """What a curated copy holds.

    Args:
        out: the copy.
        format: its format, that of the source.
        source: the data that were rated.
        drop: ``"episodes"`` or ``"samples"``.
        rule: what was dropped, in words.
        kept: names of the episodes that stay, of those that were rated.
        dropped: name of each episode that goes, or loses steps, and why.
        steps_kept: number of rated steps that stay.
        steps_dropped: number of steps that go.
        notes: what else to know.
        commands: of the format's own tools.
        written: whether the copy was written; False after a dry run.
    """

    out: str
    format: str
    source: str
    drop: str
    rule: str
    kept: tuple[str, ...]
    dropped: dict[str, str]
    steps_kept: int
    steps_dropped: int
    notes: tuple[str, ...]
    commands: tuple[str, ...]
    written: bool

    def to_json(self) -> dict[str, Any]:
        """The same as a dictionary that ``json`` can write."""
        return asdict(self)


def curate(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    drop: Literal["episodes", "samples"] = "episodes",
    share: float | None = None,
    below: float | None = None,
    keep_list: str | os.PathLike[str] | Iterable[str | int] | None = None,
    mode: int | None = None,
    name: str = "curated",
    remove: bool = False,
    force: bool = False,
    dry_run: bool = False,
    overwrite: bool = False,
) -> Curated:
    """Copies demonstrations without some episodes or steps, in the format that came in; the source stays as it is.

    Exactly one of ``share``, ``below``, ``keep_list`` and ``mode`` decides. A surprising demonstration need not be a
    bad one: look at those that go before they are gone, by ``dry_run`` and the report.

    Args:
        folder: of a rating; with ``mode``, of a search for modes.
        out: file or folder to write; a file's name ends as that of the source.
        drop: whole episodes, or single steps (npz, CSV and TED alone: elsewhere rows belong to sequences).
        share: part of the episodes (steps) to drop, in (0, 1): the most surprising ones, rounded down.
        below: surprise in decades below which an episode (step) stays.
        keep_list: names or numbers of the episodes that stay, or a JSON file with a list of them.
        mode: whose episodes stay.
        name: of the filter key (robomimic alone).
        remove: whether robomimic's episodes are removed, rather than left out of the filter key.
        force: whether to use a rating that says that it is not usable.
        dry_run: whether only to say what would be done.
        overwrite: whether to replace an earlier copy at ``out``.

    Returns:
        What was kept and dropped, and why.

    Raises:
        FileExistsError: if there is something at ``out``; with ``overwrite``, if it is no earlier copy.
        FileNotFoundError: if the rating or its data are not there.
        OSError: if the copy cannot be written. Nothing half-written is left.
        TypeError: if an argument is of a wrong kind.
        ValueError: if the rating is not usable, the data are not those that were rated, or nothing or all would go.
    """
    _check(drop, share, below, keep_list, mode, name)
    if mode is None:
        rated = RatingsFolder.open(folder)
    else:
        found = ModesFolder.open(folder)
        rated, keep_list = found.as_ratings(), found.episodes_of(mode)
    if not rated.usable and keep_list is None and not force:
        why = "; ".join(rated.reasons) or "summary.json gives no reason"
        raise ValueError(
            f"the rating in {str(folder)!r} is not usable ({why}): choose by hand with keep_list, or take the risk by "
            "force=True"
        )
    reader = _open_source(rated)
    curator_class = CURATORS.get(reader.name)
    if curator_class is None:
        raise ValueError(f"{reader.name} data cannot be copied, only {', '.join(CURATORS)}")
    keep, rows, why_dropped, rule = decide(rated, drop, share, below, keep_list)
    if mode is not None:
        rule = f"episodes of other modes than {mode}"
        why_dropped = {name: f"mode {found.mode[k]}" for k, name in enumerate(found.names) if name in why_dropped}
    source, target = Path(reader.path), Path(out).expanduser()
    plan = Plan(
        source,
        reader,
        rated.names,
        rated.lengths,
        keep,
        rows,
        rated.steps["surprise"],
        rated.steps["rating"],
        name,
        remove,
    )
    curator = curator_class(plan)
    if drop == "samples" and curator.sequence is not None:
        raise ValueError(f"drop='samples' is not possible for {reader.name}: {curator.sequence}; drop episodes")
    if remove and reader.name != "robomimic":
        raise ValueError(
            f"remove is for robomimic's filter keys, {reader.name} data always lose the episodes: leave it out"
        )
    check_place(target, source, rated.path, curator.suffixes, overwrite)
    if not rated.usable and keep_list is None:
        plan.notes.append("the rating says of itself that it is not usable")
    for left in leftovers(target):
        plan.notes.append(f"{str(left)!r} is of a copy that was not finished: remove it, unless that still runs")
    if not dry_run:
        with staged(target) as stage:
            curator.write(stage)
            done = _summary(plan, curator.commands(target), target, reader.name, drop, rule, why_dropped, True)
            if stage.is_dir():
                (stage / RECORD).write_text(json.dumps(done.to_json(), indent=1))
        if target.is_file():
            with atomic_path(record_of(target)) as file:
                file.write_text(json.dumps(done.to_json(), indent=1))
        return done
    return _summary(plan, curator.commands(target), target, reader.name, drop, rule, why_dropped, False)


def _summary(
    plan: Plan, commands: list[str], out: Path, form: str, drop: str, rule: str, why: dict[str, str], written: bool
) -> Curated:
    stays, total = int(plan.keep_rows.sum()), len(plan.keep_rows)
    kept = tuple(plan.kept)
    return Curated(
        str(out),
        form,
        str(plan.source),
        drop,
        rule,
        kept,
        why,
        stays,
        total - stays,
        tuple(plan.notes),
        tuple(commands),
        written,
    )


def _check(drop: Any, share: Any, below: Any, keep_list: Any, mode: Any, name: Any) -> None:
    if drop not in ("episodes", "samples"):
        raise ValueError(f"drop={drop!r}: choose 'episodes' or 'samples'")
    rules = {"share": share, "below": below, "keep_list": keep_list, "mode": mode}
    given = {key: value for key, value in rules.items() if value is not None}
    if len(given) != 1:
        raise ValueError(f"give exactly one of share, below, keep_list and mode, got {', '.join(given) or 'none'}")
    for key in ("share", "below"):
        value = given.get(key, 0.5)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TypeError(f"{key}={value!r} must be a finite number")
    if share is not None and not 0 < share < 1:
        raise ValueError(f"share={share} must lie between 0 and 1: it is the part of the {drop} that goes")
    if (keep_list is not None or mode is not None) and drop == "samples":
        raise ValueError(f"{next(iter(given))} names episodes, drop='samples' drops steps: use share or below")
    if not isinstance(name, str) or not name or "/" in name:
        raise ValueError(f"name={name!r} must be a text without '/'")


def _open_source(rated: RatingsFolder) -> Reader:
    """The data that were rated.

    Raises:
        FileNotFoundError: if they are not where they were.
        ValueError: if they are others now.
    """
    said = rated.run["data"]
    path, form = said.get("path"), said.get("format")
    if not path or form == "memory":
        raise ValueError(
            f"the data rated in {str(rated.path)!r} were in memory, there is no file to copy: save them, and rate "
            "the file"
        )
    if not Path(path).exists():
        raise FileNotFoundError(
            f"the data rated in {str(rated.path)!r} are not at {str(path)!r} any more: move them back"
        )
    # Options that the run noted; keys of observation and action are not needed to copy rows.
    episode, action = said.get("episode"), (said.get("keys") or {}).get("action")
    options = Options(
        observation=(),
        action=action if form == "npz" and isinstance(action, str) else action[0] if form == "npz" and action else None,
        episode=episode if form in ("npz", "csv") else None,
    )
    reader = open_reader(path, options, format=form)
    lengths = reader.lengths()
    for name, length in zip(rated.names, rated.lengths.tolist(), strict=True):
        if lengths.get(name) != length:
            has = "no such episode" if name not in lengths else f"{lengths[name]} steps in it"
            raise ValueError(
                f"episode {name!r} had {length} steps when {str(path)!r} was rated, now there is {has}: rate the data "
                "again"
            )
    order = [name for name in lengths if name in set(rated.names)]
    unrated = len(lengths) - len(order)
    if order != list(rated.names) or (unrated and form not in ("robomimic", "lerobot")):
        raise ValueError(f"the episodes of {str(path)!r} are not those that were rated: rate the data again")
    return reader
