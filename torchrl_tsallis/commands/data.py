"""Commands that read demonstrations: info, rate, modes, train."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torchrl_tsallis.commands.options import (
    Logs,
    ModesTraining,
    PolicyTraining,
    RateTraining,
    Reads,
    command_line,
    note,
    say,
)


@dataclass(kw_only=True)
class Info(Reads):
    """Says what a file holds, and faults that can be seen without training."""

    def __call__(self, words: Sequence[str]) -> int:
        """Describes first: what cannot be read is described too."""
        from torchrl_tsallis.data.hygiene import inspect_demonstrations
        from torchrl_tsallis.data.readers import describe, read_demonstrations

        found = describe(self.path, format=self.format, filter_key=self.filter_key, episode=self.episode)
        options = self.chosen()
        options["observation"] = options.pop("obs")
        error: Exception | None = None
        findings = []
        try:
            findings = inspect_demonstrations(read_demonstrations(self.path, check=False, **options).data)
        except (KeyError, TypeError, ValueError) as failed:
            error = failed
        lines = [f"{found.path}: {found.format}, {len(found.episodes)} episodes, {found.steps} steps"]
        if found.pairs:
            lines[0] = f"{found.path}: {found.format}, {found.steps} pairs without episodes"
        lengths = sorted(found.episodes.values())
        if lengths and not found.pairs:
            lines.append(f"steps of an episode: {lengths[0]} to {lengths[-1]}, median {lengths[len(lengths) // 2]}")
        for key, column in found.columns.items():
            image = ", an image" * column.image + ", not numbers" * (not column.readable)
            lines.append(f"  {key}: {column.dtype} {list(column.shape)}, {column.role}{image}")
        for finding in findings:
            lines.append(f"{finding.severity}: {finding.what} ({finding.where}): {finding.fix}")
        if error is None and not findings:
            lines.append("no faults found")
        answer = {**found.to_json(), "steps": found.steps, "findings": [finding.to_json() for finding in findings]}
        say(answer, "\n".join(lines), self.json)
        if error is not None:
            raise error
        return 0


@dataclass(kw_only=True)
class Rate(Logs, Reads):
    """Rates demonstrations by policies that did not see them; leaves a folder with tables, report and policy.

    Args:
        out: folder to write.
        train: of the policies.
        device: of the policies, such as cuda.
        overwrite: whether an earlier run in the folder is replaced.
        fail_below: exit with 2 where the rating is not usable, or the seeds agree less (the greater one of Spearman's
            rho and the reliability, in summary.json).
    """

    out: Path = Path("ratings")
    train: RateTraining = field(default_factory=RateTraining)
    device: str = "cpu"
    overwrite: bool = False
    fail_below: float | None = None

    def __call__(self, words: Sequence[str]) -> int:
        """Rates, and writes the report where its packages are installed."""
        from torchrl_tsallis.run import rate

        self.check_log()
        run = rate(
            self.path,
            self.out,
            **self.chosen(),
            **vars(self.train),
            device=self.device,
            overwrite=self.overwrite,
            progress=not self.json,
            command=command_line(words),
        )
        summary = run.summary
        page: Path | None = None
        failed = 0
        try:
            from torchrl_tsallis.report.page import write_report

            page = write_report(self.out)
        except ImportError as error:  # it names what to install
            note(f"no report: {error}")
        except (OSError, ValueError) as error:
            note(f"no report: {error}; the ratings are in {str(self.out)!r}")
            failed = 1
        logs: Path | None = None
        try:
            logs = self.send(self.out)
        except (ImportError, OSError, RuntimeError, ValueError) as error:  # RuntimeError: of wandb
            note(f"nothing logged: {error}; the ratings are in {str(self.out)!r}, tsallis report sends them again")
            failed = 1
        answer = {"out": str(self.out), "report": None if page is None else str(page), **summary}
        answer |= {} if self.log is None else {"logs": None if logs is None else str(logs)}
        lines = [
            summary["sentence"],
            str(self.out if page is None else page),
            *([] if logs is None else [f"logs: {logs}"]),
        ]
        say(answer, "\n".join(lines), self.json)
        agree = max((summary["agreement"].get(name) or -1.0 for name in ("spearman", "reliability")), default=-1.0)
        low = self.fail_below is not None and (not summary["usable"] or agree < self.fail_below)
        return failed or 2 * low


@dataclass(kw_only=True)
class Modes(Reads):
    """Finds whose demonstrations these are: modes of behaviour among whole episodes, without labels.

    Args:
        out: folder to write.
        labels: key of what is known of each episode, such as its operator, which what was found is compared with; mask
            for the filter keys of robomimic. It is never used in the search.
        by: what modes are found by: distributions of what happens in an episode (seconds), or policies, mixtures of
            which are trained (minutes); these see operators who do other things in the same situations.
        components: auto, or a number of modes, whether they lie apart or not; by policies of a mixture's components.
        train: of the mixtures, and of the policies that show how modes differ.
        device: of the policies, such as cuda.
        overwrite: whether an earlier run in the folder is replaced.
    """

    out: Path = Path("modes")
    labels: str | None = None
    by: Literal["distributions", "policies"] = "distributions"
    components: Literal["auto"] | int = "auto"
    train: ModesTraining = field(default_factory=ModesTraining)
    device: str = "cpu"
    overwrite: bool = False

    def __call__(self, words: Sequence[str]) -> int:
        """Finds them."""
        from torchrl_tsallis.run import modes

        found = modes(
            self.path,
            self.out,
            **self.chosen(),
            **vars(self.train),
            labels=self.labels,
            by=self.by,
            components=None if self.components == "auto" else self.components,
            device=self.device,
            overwrite=self.overwrite,
            progress=not self.json,
            command=command_line(words),
        )
        lines = [found.summary["sentence"], str(self.out / "modes.csv")]
        try:
            from torchrl_tsallis.report.modes_page import write_modes_report

            lines.append(str(write_modes_report(self.out)))
        except ImportError as error:
            note(f"no page: {error}")
        if len(found.summary["modes"]) > 1:
            best = found.summary["recommended"]
            lines.append(f"tsallis curate {self.out} --mode {best} --out COPY    # that mode alone, in the same format")
            lines.append(f"tsallis train {self.out} --mode {best} --out POLICY   # a policy of it")
            lines.append(f"tsallis train {self.out} --mode each --out POLICY     # one of all, which is told the mode")
        say({"out": str(self.out), **found.summary}, "\n".join(lines), self.json)
        return 0


@dataclass(kw_only=True)
class Train(Reads):
    """Trains a policy on all of the demonstrations, of which those that are noise count less; or on one mode of them.

    Args:
        out: folder to write.
        mode: number of a mode, or each for one policy that is told the mode; the path is then the folder that tsallis
            modes left.
        train: of the policy.
        device: of the policy, such as cuda.
        overwrite: whether an earlier run in the folder is replaced.
    """

    out: Path
    mode: int | Literal["each"] | None = None
    train: PolicyTraining = field(default_factory=PolicyTraining)
    device: str = "cpu"
    overwrite: bool = False

    def __call__(self, words: Sequence[str]) -> int:
        """Trains."""
        from torchrl_tsallis.run import train

        run = train(
            self.path,
            self.out,
            **self.chosen(),
            **vars(self.train),
            mode=self.mode,
            device=self.device,
            overwrite=self.overwrite,
            progress=not self.json,
            command=command_line(words),
        )
        card = self.out / "README.md"
        text = f"{card} says what the policy was made of, and how to load it"
        say({"out": str(self.out), "card": str(card), **run.settings}, text, self.json)
        return 0
