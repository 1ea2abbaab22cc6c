"""The page of a search for modes: one HTML file that needs nothing else, and its pictures as a PNG file."""

from __future__ import annotations

import csv
import os
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.modes_folder import ModesFolder
from torchrl_tsallis.jobs.files import atomic_path
from torchrl_tsallis.report.contents import number
from torchrl_tsallis.report.figures import new_figure
from torchrl_tsallis.report.modes import colour_of, draw_differences, draw_modes, draw_together
from torchrl_tsallis.report.page import need_packages
from torchrl_tsallis.report.pictures import Panel
from torchrl_tsallis.runs.saved import load_tensors
from torchrl_tsallis.version import __version__

#: Names of the page and of its pictures.
PAGE, PICTURE = "modes.html", "modes.png"
#: Pairs of modes, and names of a mode's episodes, that are shown.
MOST_PAIRS, MOST_NAMES = 3, 200


def write_modes_report(folder: str | os.PathLike[str]) -> Path:
    """Writes ``modes.html`` and ``modes.png`` into the folder of a search for modes.

    The page says in this order: what was found and how sure it is, which mode to imitate, the modes with their
    episodes, how often episodes were together, where the modes differ, how the user's own labels go with them, and what
    was run. It loads nothing, and all that comes from the data is escaped.

    Args:
        folder: that ``tsallis modes`` left; an earlier page in it is replaced.

    Returns:
        The page.

    Raises:
        FileNotFoundError: if the folder or a file in it is not there.
        ImportError: if jinja2 or matplotlib is not installed.
        OSError: if a file cannot be written; those that are there stay whole.
        ValueError: if a file is broken.
    """
    need_packages()
    found = ModesFolder.open(folder)
    pairs = load_tensors(found.path / "pairs.safetensors")["pairs"].numpy()
    text = _render(found, pairs, os.fspath(folder))
    figure, (left, right) = new_figure(10, 4, columns=2)
    draw_together(left, pairs, found.mode, found.summary["by"])
    draw_modes(right, found.mode, found.membership)
    with atomic_path(found.path / PICTURE) as path:
        figure.savefig(path, format="png", facecolor="white")
    with atomic_path(found.path / PAGE) as path:
        path.write_text(text, encoding="utf-8")
    return found.path / PAGE


def read_differences(found: ModesFolder) -> dict[tuple[int, int], np.ndarray]:
    """What ``differences.csv`` holds, ``[T, A]`` a pair of modes; empty where there is no such file."""
    file = found.path / "differences.csv"
    if not file.exists():
        return {}
    values: dict[tuple[int, int], dict[tuple[int, int], float]] = {}
    with file.open(newline="", encoding="utf-8") as handle:
        try:
            for row in csv.DictReader(handle):
                pair, place = (int(row["mode"]), int(row["other"])), (int(row["part"]), int(row["action"]))
                values.setdefault(pair, {})[place] = float(row["difference"])
            shapes = {pair: np.max(list(cells), axis=0) + 1 for pair, cells in values.items()}
            return {
                pair: np.array([[cells[t, a] for a in range(shapes[pair][1])] for t in range(shapes[pair][0])])
                for pair, cells in values.items()
            }
        except (KeyError, TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"{str(file)!r} is broken ({error}): find the modes again") from error


def most_different(apart: np.ndarray) -> str:
    """Where two modes differ most, in words.

    Examples:
        >>> most_different(np.array([[0.0, 0.1], [2.0, 0.3]]))
        'most in dimension 0 of the action, from 50 to 100 % of the episode (2 robust deviations)'
    """
    part, dim = np.unravel_index(int(apart.argmax()), apart.shape)
    start, end = (number(100 * (part + k) / len(apart), 3) for k in (0, 1))
    most = number(float(apart.max()), 2)
    return f"most in dimension {dim} of the action, from {start} to {end} % of the episode ({most} robust deviations)"


def _render(found: ModesFolder, pairs: np.ndarray, folder: str) -> str:
    import jinja2

    here = resources.files("torchrl_tsallis.report")
    template, style = ((here / name).read_text(encoding="utf-8") for name in ("modes.html.j2", "page.css"))
    listed: list[dict[str, Any]] = []
    for mode in found.summary["modes"]:
        own = [name for name, k in zip(found.names, found.mode.tolist(), strict=True) if k == mode["mode"]]
        listed.append({**mode, "colour": colour_of(mode["mode"], mode["episodes"]), "names": own[:MOST_NAMES]})
    strip = Panel(
        partial(draw_modes, mode=found.mode, membership=found.membership),
        f"All {len(found.names)} episodes in the order of the data, each in the colour of its mode",
        9.6,
        2.6,
    )
    close = partial(draw_together, pairs=pairs, mode=found.mode, by=found.summary["by"])
    together = Panel(close, "How close each two episodes are", 5, 4)
    differing = []
    for (a, b), apart in list(read_differences(found).items())[:MOST_PAIRS]:
        colours = (colour_of(a, 2), colour_of(b, 2))
        panel = Panel(partial(draw_differences, apart=apart, colours=colours), f"Where modes {a} and {b} differ", 5, 3)
        differing.append({"svg": panel.svg(f"apart{a}-{b}"), "a": a, "b": b, "most": most_different(apart)})
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(template).render(
        style=style,
        number=number,
        title=Path(str(found.run["data"].get("path") or folder)).name,
        folder=folder,
        steps=int(found.lengths.sum()),
        episodes=len(found.names),
        large=[mode for mode in listed if mode["episodes"] > 1],
        alone=[mode for mode in listed if mode["episodes"] == 1],
        strip=strip.svg("strip"),
        together=together.svg("together"),
        differing=differing,
        labels=found.summary.get("labels"),
        summary=found.summary,
        run=found.run,
        version=__version__,
    )
