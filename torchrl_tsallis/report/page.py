"""The page of a rating: one HTML file that needs nothing else, from what the folder holds."""

from __future__ import annotations

import importlib
import os
from importlib import resources
from pathlib import Path
from typing import Any

from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.jobs.files import atomic_path
from torchrl_tsallis.report import contents, figures
from torchrl_tsallis.report.pictures import Panel, as_file, panels
from torchrl_tsallis.report.svg import sparkline
from torchrl_tsallis.version import __version__

#: Name of the page.
PAGE = "report.html"


def need_packages() -> None:
    """Raises ImportError where jinja2 or matplotlib is not installed; the message names the extra."""
    for package in ("jinja2", "matplotlib"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ImportError(f"the report needs {package}: pip install 'torchrl-tsallis[report]'") from error


def write_report(folder: str | os.PathLike[str]) -> Path:
    """Writes ``report.html``, and PNG files of its pictures, into the folder of a rating.

    The page says in this order: the verdict and how sure it is, whether the rating is usable, which episodes to review
    first, all episodes, the worst ones step by step, the simple signals, faults of the data, and what was run. It loads
    nothing, is readable without scripts, and follows the reader's light or dark scheme. All that comes from
    the data is escaped.

    Args:
        folder: that a rating left; an earlier report in it is replaced.

    Returns:
        The page.

    Raises:
        FileNotFoundError: if the folder or a file in it is not there.
        ImportError: if jinja2 or matplotlib is not installed.
        OSError: if a file cannot be written; those that are there stay whole.
        ValueError: if a file is broken; the message names it.
    """
    need_packages()
    rated = RatingsFolder.open(folder)
    judged = contents.judged(rated)
    drawn = panels(rated, judged["calibration"])
    text = _render(rated, judged, drawn, os.fspath(folder))
    for name, several in drawn.items():
        with atomic_path(rated.path / f"{name}.png") as temporary:
            as_file(several).savefig(temporary, format="png", facecolor="white")
    with atomic_path(rated.path / PAGE) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return rated.path / PAGE


def _render(rated: RatingsFolder, judged: dict[str, Any], drawn: dict[str, list[Panel]], folder: str) -> str:
    import jinja2

    here = resources.files("torchrl_tsallis.report")
    template, style, script = (
        (here / name).read_text(encoding="utf-8") for name in ("page.html.j2", "page.css", "page.js")
    )
    rows, by_episode = contents.queue(rated), contents.parts(rated, "surprise")
    for row in rows:
        said = f"Surprise along the episode of rank {row['rank']}, greatest at step {row['worst'][0]}"
        row["spark"] = sparkline(by_episode[row["place"]], figures.MOST, said)
    pictures: dict[str, list[str]] = {
        name: [panel.svg(f"{name}{k}") for k, panel in enumerate(several)] for name, several in drawn.items()
    }
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    marked = contents.stand_out(contents.column(rated, "surprise"), contents.column(rated, "low"))
    return environment.from_string(template).render(
        style=style,
        script=script,
        number=contents.number,
        title=Path(str(rated.run["data"].get("path") or folder)).name,
        usable=rated.usable,
        rows=rows,
        episodes=len(rated.names),
        steps=len(rated.steps["row"]),
        outstanding=int(marked.sum()),
        signals=contents.shown(rated),
        beside=contents.beside(rated),
        kept=contents.kept(rated),
        commands=contents.commands(rated, folder),
        facts=contents.facts(rated),
        pictures=pictures,
        version=__version__,
        **judged,
    )
