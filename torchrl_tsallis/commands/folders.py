"""Commands that read the folder of a run: report, curate, export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchrl_tsallis.commands.options import Logs, say


@dataclass(kw_only=True)
class Report(Logs):
    """Writes the page of a rating again, from what its folder holds, and logs it where that is asked for.

    Args:
        folder: that tsallis rate left.
        json: whether to answer with an object of JSON.
    """

    folder: tyro.conf.Positional[Path]
    json: bool = False

    def __call__(self, words: Sequence[str]) -> int:
        """Writes it."""
        from torchrl_tsallis.report.page import write_report

        self.check_log()
        page = write_report(self.folder)
        logs = self.send(self.folder)
        text = str(page) if logs is None else f"{page}\nlogs: {logs}"
        say({"report": str(page)} | ({} if logs is None else {"logs": str(logs)}), text, self.json)
        return 0


@dataclass(kw_only=True)
class Curate:
    """Copies demonstrations without the most surprising ones, in their format; look at them before.

    Args:
        folder: that tsallis rate left; with --mode, that tsallis modes left.
        out: file or folder to write.
        drop: whole episodes, or single steps (npz, CSV and TED).
        share: part of the episodes (steps) to drop: the most surprising ones.
        below: surprise in decades below which an episode (step) stays.
        keep_list: JSON file with the names of the episodes that stay.
        mode: number of the mode whose episodes stay.
        name: of the filter key (robomimic).
        remove: whether robomimic's episodes are removed rather than left out of the filter key.
        force: whether to use a rating that says that it is not usable.
        dry_run: whether only to say what would be done.
        overwrite: whether to replace an earlier copy.
        json: whether to answer with an object of JSON.
    """

    folder: tyro.conf.Positional[Path]
    out: Path
    drop: Literal["episodes", "samples"] = "episodes"
    share: float | None = None
    below: float | None = None
    keep_list: Annotated[Path | None, tyro.conf.arg(name="list")] = None
    mode: int | None = None
    name: str = "curated"
    remove: bool = False
    force: bool = False
    dry_run: bool = False
    overwrite: bool = False
    json: bool = False

    def __call__(self, words: Sequence[str]) -> int:
        """Copies."""
        from torchrl_tsallis.data.curation import curate

        options = {name: value for name, value in vars(self).items() if name not in ("folder", "out", "json")}
        done = curate(self.folder, self.out, **options)
        verb = "written" if done.written else "not written, dry run"
        lines = [
            f"{done.rule}: {len(done.kept)} episodes with {done.steps_kept} steps stay, {done.steps_dropped} steps go",
            *(f"  {name}: {why}" for name, why in done.dropped.items()),
            *done.notes,
            *done.commands,
            f"{done.out} ({verb})",
        ]
        say(done.to_json(), "\n".join(lines), self.json)
        return 0


@dataclass(kw_only=True)
class Export:
    """Writes the mean policy of a run as ONNX, with its scaling inside.

    Args:
        folder: that tsallis rate or tsallis train left.
        onnx: file to write.
        overwrite: whether a file that is there is replaced.
        json: whether to answer with an object of JSON.
    """

    folder: tyro.conf.Positional[Path]
    onnx: Path
    overwrite: bool = False
    json: bool = False

    def __call__(self, words: Sequence[str]) -> int:
        """Exports, and compares onnxruntime's actions where that is installed."""
        from torchrl_tsallis.runs import Run
        from torchrl_tsallis.runs.policies import export_onnx

        apart = export_onnx(Run.open(self.folder).network(), self.onnx, overwrite=self.overwrite)
        checked = "onnxruntime is not installed: not compared" if apart is None else f"differs by {apart:.1g}"
        say({"onnx": str(self.onnx), "difference": apart}, f"{self.onnx} ({checked})", self.json)
        return 0
