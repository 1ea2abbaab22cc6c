"""The folder of a search for modes: which episodes of which data are of which mode, and how sure that is."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.ratings_folder import RatingsFolder, numbers_of, read_table, read_text

_COLUMNS = ("episode", "source", "steps", "mode", "membership")
KIND = "modes"


@dataclass(frozen=True)
class ModesFolder:
    """What a folder of modes holds.

    Args:
        path: the folder.
        run: ``run.json``: data, keys, numbers of the search, versions, command.
        summary: ``summary.json``: the modes, the recommended one, how sure both are.
        names: of the episodes in the source, ``[E]``.
        lengths: steps of each episode, ``[E]``.
        mode: number of each episode's mode, ``[E]``.
        membership: how often it is of one component with the others of its mode, ``[E]``.
    """

    path: Path
    run: dict[str, Any]
    summary: dict[str, Any]
    names: tuple[str, ...]
    lengths: np.ndarray
    mode: np.ndarray
    membership: np.ndarray

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> ModesFolder:
        """Reads a folder that a search for modes left.

        Args:
            folder: with ``run.json``, ``summary.json`` and ``modes.csv``.

        Returns:
            Its contents.

        Raises:
            FileNotFoundError: if the folder or a file is not there.
            ValueError: if it is no such folder, or a file is broken.
        """
        path = Path(folder).expanduser()
        if not path.is_dir():
            raise FileNotFoundError(f"there is no folder {str(path)!r}: find the modes first, by tsallis modes")
        run = read_text(path / "run.json")
        if run.get("kind") != KIND or not isinstance(run.get("data"), dict):
            raise ValueError(
                f"{str(path)!r} is a run of kind {run.get('kind')!r}, needed is one of modes: find them by "
                "tsallis modes"
            )
        file = path / "modes.csv"
        cells = read_table(file, _COLUMNS)
        names = tuple(cells.pop("source"))
        found = {key: numbers_of(file, key, cells[key]) for key in ("steps", "mode", "membership")}
        whole = all((found[key] == found[key].round()).all() for key in ("steps", "mode"))
        if not names or len(set(names)) < len(names) or not whole or not (found["steps"] >= 1).all():
            raise ValueError(
                f"{str(file)!r} must name each episode once, with its steps and mode: find the modes again"
            )
        lengths, mode = (found[key].astype(np.int64) for key in ("steps", "mode"))
        return cls(path, run, read_text(path / "summary.json"), names, lengths, mode, found["membership"])

    def episodes_of(self, mode: int) -> list[str]:
        """Names of a mode's episodes.

        Raises:
            ValueError: if there is no such mode.
        """
        own = [name for name, number in zip(self.names, self.mode.tolist(), strict=True) if number == mode]
        if isinstance(mode, bool) or not own:
            known = ", ".join(map(str, sorted(set(self.mode.tolist()))))
            raise ValueError(f"mode={mode!r} is none of those in {str(self.path)!r}: choose of {known}")
        return own

    def as_ratings(self) -> RatingsFolder:
        """What a curated copy is made from: an episode's rating is its membership, and it has no surprise."""
        rows = int(self.lengths.sum())
        steps = {"rating": np.repeat(self.membership, self.lengths), "surprise": np.full(rows, np.nan)}
        episodes = {"surprise": np.full(len(self.names), np.nan)}
        return RatingsFolder(
            self.path, self.run, {**self.summary, "usable": True}, self.names, self.lengths, episodes, steps
        )
