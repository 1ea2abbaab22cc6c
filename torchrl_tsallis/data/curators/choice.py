"""Which episodes or steps stay: by a share, by a bound, or by a list."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.ratings_folder import RatingsFolder


def decide(
    rated: RatingsFolder, drop: str, share: float | None, below: float | None, keep_list: Any
) -> tuple[np.ndarray, np.ndarray, dict[str, str], str]:
    """Decides what stays.

    Args:
        rated: the rating, ``E`` episodes and ``N`` steps.
        drop: ``"episodes"`` or ``"samples"``.
        share: part of them to drop.
        below: surprise below which they stay.
        keep_list: episodes that stay.

    Returns:
        Episodes ``[E]`` and steps ``[N]`` that stay, why the others go by episode, and the rule in words. What has no
        surprise stays.

    Raises:
        TypeError: if the list is none of names.
        ValueError: if nothing or all would go, or the list names an episode that is not there.
    """
    if keep_list is not None:
        listed = _listed(keep_list, rated.names)
        keep = np.array([name in listed for name in rated.names])
        rule = f"episodes that are not among the {len(listed)} of the keep list"
        why = {name: "not in the keep list" for name, stays in zip(rated.names, keep, strict=True) if not stays}
        return (*_not_all(keep, np.repeat(keep, rated.lengths), "episodes"), why, rule)
    surprise = rated.steps["surprise"] if drop == "samples" else rated.episodes["surprise"]
    known = np.flatnonzero(~np.isnan(surprise))
    stays = np.ones(len(surprise), dtype=bool)
    if share is not None:
        count = int(share * len(surprise) + 1e-9)
        if not count:
            raise ValueError(
                f"share={share} of {len(surprise)} {drop} is none: at least {1 / len(surprise):.2g} drops one"
            )
        stays[known[np.argsort(-surprise[known], kind="stable")][:count]] = False
        rule = f"the {share:g} of the {drop} with the greatest surprise"
    else:
        stays[known[surprise[known] >= below]] = False
        rule = f"{drop} with a surprise of {below:g} or more"
    if drop == "samples":
        parts = np.split(stays, np.cumsum(rated.lengths)[:-1])
        keep = np.array([bool(part.any()) for part in parts])
        lost = [int((~part).sum()) for part in parts]
        why = {
            name: f"{count} of {length} steps" if count < length else "all its steps"
            for name, count, length in zip(rated.names, lost, rated.lengths.tolist(), strict=True)
            if count
        }
        return (*_not_all(keep, stays, drop), why, rule)
    why = {rated.names[k]: f"surprise {surprise[k]:.3g}" for k in np.flatnonzero(~stays).tolist()}
    return (*_not_all(stays, np.repeat(stays, rated.lengths), drop), why, rule)


def _not_all(keep: np.ndarray, rows: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    if not rows.any():
        raise ValueError(f"all {what} would go: choose a smaller share, a greater bound, or a longer list")
    return keep, rows


def _listed(keep_list: Any, names: Sequence[str]) -> set[str]:
    """Names in the list, or behind the numbers in it.

    Raises:
        TypeError: if it is no list of names.
        ValueError: if it names an episode that is not there.
    """
    where = "keep_list"
    if isinstance(keep_list, (str, os.PathLike)):
        file = Path(keep_list).expanduser()
        where = repr(str(file))
        try:
            keep_list = json.loads(file.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise FileNotFoundError(
                error.errno, f"the keep list {where} is not there: write the names as a JSON list"
            ) from error
        except ValueError as error:
            raise ValueError(f"the keep list {where} is no JSON ({error}): write the names as a list") from error
        if isinstance(keep_list, dict) and "keep" in keep_list:
            keep_list = keep_list["keep"]
    entries = None if isinstance(keep_list, dict) else list(keep_list) if isinstance(keep_list, Iterable) else None
    if entries is None or any(isinstance(x, bool) or not isinstance(x, (str, int)) for x in entries):
        raise TypeError(f"{where} must be a list of names or numbers of episodes, or {{'keep': [...]}}")
    # A number is that in the source: 3 is episode_3 of Minari and demo_3 of robomimic.
    numbered = {name.rpartition("_")[2]: name for name in names}
    found, unknown = set(), []
    for entry in map(str, entries):
        if entry in names:
            found.add(entry)
        elif entry in numbered:
            found.add(numbered[entry])
        else:
            unknown.append(entry)
    if unknown:
        raise ValueError(
            f"{where} names {len(unknown)} episodes that were not rated, first {unknown[:3]}; there are "
            f"{list(names[:5])}, ..."
        )
    return found
