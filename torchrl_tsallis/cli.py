"""The command line ``tsallis``: a thin layer over :mod:`torchrl_tsallis.run`."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro


def _say(value: dict[str, Any], text: str, as_json: bool) -> None:
    sys.stdout.write((json.dumps(value, default=str) if as_json else text) + "\n")


def info(path: tyro.conf.Positional[Path], /, format: str | None = None, json: bool = False) -> int:
    """Says what a file holds; nothing is trained."""
    from torchrl_tsallis.data.readers import describe

    found = describe(path, format=format)
    keys = "".join(
        f"\n  {key}: {column.dtype} {list(column.shape)} {column.role}" for key, column in found.columns.items()
    )
    _say(found.to_json(), f"{found.format}: {len(found.episodes)} episodes, {found.steps} steps{keys}", json)
    return 0


def rate(
    path: tyro.conf.Positional[Path],
    /,
    out: Path = Path("ratings"),
    obs: tuple[str, ...] | None = None,
    action: str | None = None,
    episode: str | None = None,
    format: str | None = None,
    filter_key: str | None = None,
    steps: int | None = None,
    seeds: int = 3,
    folds: int = 2,
    device: str = "cpu",
    overwrite: bool = False,
    json: bool = False,
    fail_below: float | None = None,
) -> int:
    """Rates demonstrations; with --fail-below X the exit code is 2 where the seeds agree less than X, or not usable."""
    from torchrl_tsallis.run import rate as rate_

    command = shlex.join(["tsallis", *sys.argv[1:]])
    run = rate_(
        path, out, obs=obs, action=action, episode=episode, format=format, filter_key=filter_key, steps=steps,
        seeds=seeds, folds=folds, device=device, overwrite=overwrite, progress=not json, command=command,
    )  # fmt: skip
    summary = run.summary
    _say({"out": str(out), **summary}, f"{summary['sentence']}\n{out}", json)
    rho = summary["agreement"]["spearman"]
    return 2 if fail_below is not None and (not summary["usable"] or rho is None or rho < fail_below) else 0


def export(folder: tyro.conf.Positional[Path], /, onnx: Annotated[Path, tyro.conf.arg()], json: bool = False) -> int:
    """Writes the mean policy of a run as ONNX, with its scaling inside."""
    from torchrl_tsallis.runs import Run
    from torchrl_tsallis.runs.policies import export_onnx

    apart = export_onnx(Run.open(folder).network(), onnx)
    _say({"onnx": str(onnx), "difference": apart}, f"{onnx} (difference of onnxruntime: {apart})", json)
    return 0


def main(args: Sequence[str] | None = None) -> None:
    """Runs a command; exit code 0, 1 with one line for an error, 2 for --fail-below."""
    commands: dict[str, Any] = {"info": info, "rate": rate, "export": export}
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(commands, args=args)
    except KeyboardInterrupt:
        sys.stderr.write("tsallis: stopped; nothing was written\n")
        code = 130
    except (OSError, KeyError, TypeError, ValueError, ImportError, RuntimeError, ArithmeticError) as error:
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        sys.stderr.write("tsallis: " + " ".join(str(text).split()) + "\n")
        code = 1
    sys.exit(code)
