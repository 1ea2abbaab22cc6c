"""What a report says, from the folder of a rating: numbers and sentences, no pictures."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tsallis.data.ratings_folder import RatingsFolder
from torchrl_tsallis.report.figures import MARKED, MOST
from torchrl_tsallis.report.signals import RETURN, SIGNALS, Signal, most_extreme
from torchrl_tsallis.runs.judgement import spearman, stand_out

#: Episodes in the table and in the picture of the intervals, and episodes of which the course is drawn.
LISTED, DRAWN = 200, 6
#: Episodes of which the page holds a list to keep.
KEPT = 2000


def number(value: float, digits: int = 3) -> str:
    """A number for people; a dash where there is none.

    Examples:
        >>> number(0.123456), number(12345.0), number(float("nan"))
        ('0.123', '12345', '–')
    """
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.{digits}g}"


def column(rated: RatingsFolder, key: str) -> np.ndarray:
    """A column of ``episodes.csv``, ``[E]``; NaN where it is missing."""
    return rated.episodes.get(key, np.full(len(rated.names), np.nan))


def stretch(surprise: np.ndarray) -> tuple[int, int] | None:
    """First and last step of the longest run of steps with :data:`MARKED` decades or more; None if there is none.

    Examples:
        >>> stretch(np.array([0.0, 4.0, 5.0, 0.0, 4.0]))
        (1, 2)
    """
    over = np.concatenate([[False], surprise >= MARKED, [False]])
    edges = np.flatnonzero(np.diff(over.astype(int))).reshape(-1, 2)
    if not len(edges):
        return None
    first, last = edges[np.argmax(edges[:, 1] - edges[:, 0])].tolist()
    return first, last - 1


def parts(rated: RatingsFolder, key: str) -> list[np.ndarray]:
    """A column of ``ratings.csv`` by episode."""
    return np.split(rated.steps[key], np.cumsum(rated.lengths)[:-1])


def order(mean: np.ndarray) -> np.ndarray:
    """Episodes by surprise, the greatest first; those without one last, ``[E]``."""
    return np.argsort(-np.nan_to_num(mean, nan=-np.inf), kind="stable")


def queue(rated: RatingsFolder, most: int = LISTED) -> list[dict[str, Any]]:
    """The rows of the table of the worst episodes, so many at most; each cell a pair of text and number."""
    mean, low, high = (column(rated, key) for key in ("surprise", "low", "high"))
    marked, by_episode = stand_out(mean, low), parts(rated, "surprise")
    signals = [column(rated, signal.key) for signal in shown(rated)]
    rows = []
    for rank, k in enumerate(order(mean)[:most].tolist(), 1):
        steps = by_episode[k]
        worst = int(np.argmax(np.nan_to_num(steps, nan=-1.0)))
        long, over = stretch(steps), float(np.mean(steps >= MARKED))
        between = f"{number(low[k])} to {number(min(high[k], MOST))}" if math.isfinite(low[k]) else "–"
        rows.append(
            {
                "place": k,
                "rank": rank,
                "name": rated.names[k],
                "marked": bool(marked[k]),
                "surprise": (number(mean[k]), _sortable(mean[k])),
                "interval": (between, _sortable(low[k])),
                "share": (f"{100 * over:.0f} %", over),
                "worst": (f"{worst}", worst),
                "stretch": (
                    f"{long[0]}–{long[1]}" if long else "–",
                    long[1] - long[0] + 1 if long else 0,
                ),
                "signals": [(number(values[k]), _sortable(values[k])) for values in signals],
            }
        )
    return rows


def _sortable(value: float) -> float | str:
    return float(value) if math.isfinite(value) else ""


def shown(rated: RatingsFolder) -> list[Signal]:
    """The signals of which some episode has one."""
    return [signal for signal in (*SIGNALS, RETURN) if not np.isnan(column(rated, signal.key)).all()]


def beside(rated: RatingsFolder) -> list[dict[str, Any]]:
    """The signals beside the surprise: rank correlation, and the episodes that each would look at first."""
    surprise, out = column(rated, "surprise"), []
    for signal in shown(rated):
        values = column(rated, signal.key)
        first = [rated.names[k] for k in most_extreme(values, signal.extreme)]
        few = np.isfinite(values + surprise).sum() < 3
        rho = math.nan if few else spearman(values, surprise, constant=math.nan)
        out.append({"signal": signal, "rho": number(rho, 2).replace("-", "−"), "first": first})
    return out


def kept(rated: RatingsFolder) -> str | None:
    """Names of all episodes that do not stand out, as JSON; None where none stands out, or the list is long."""
    marked = stand_out(column(rated, "surprise"), column(rated, "low"))
    if not marked.any() or marked.all() or len(marked) > KEPT:
        return None
    return json.dumps([name for name, out in zip(rated.names, marked, strict=True) if not out], ensure_ascii=False)


def commands(rated: RatingsFolder, folder: str) -> list[tuple[str, str]]:
    """What each command does, and the command."""
    data = rated.run["data"]
    path, place = data.get("path"), shlex.quote(folder)
    if not path or data.get("format") == "memory":
        return []
    source = Path(str(path))
    out = shlex.quote(f"{source.stem}_curated{source.suffix}" if source.suffix else f"{source.name}_curated")
    found = []
    if rated.usable:
        share = max(0.05, math.ceil(100 / len(rated.names)) / 100)
        found.append(
            (
                f"say which {share:.0%} of the episodes would go, and write nothing",
                f"tsallis curate {place} --out {out} --share {share:g} --dry-run",
            )
        )
        found.append(("drop them: write a copy without them", f"tsallis curate {place} --out {out} --share {share:g}"))
    listed = "keep the episodes that you listed in keep.json, after you looked"
    found.append((listed, f"tsallis curate {place} --out {out} --list keep.json"))
    found.append(("train a policy on the copy", f"tsallis train {out} --out policy"))
    return found


def facts(rated: RatingsFolder) -> list[tuple[str, str]]:
    """What was run, as pairs of name and value."""
    run, summary = rated.run, rated.summary
    data, method, train, versions = (_object(run.get(key)) for key in ("data", "method", "train", "versions"))
    keys = _object(data.get("keys"))
    pairs: list[tuple[str, Any]] = [
        ("Data", data.get("path") or "in memory"),
        ("Format", data.get("format")),
        *((f"Keys of the {role}", ", ".join(map(str, _list(names)))) for role, names in keys.items()),
        ("Episodes and steps", f"{len(rated.names)} and {len(rated.steps['row'])}"),
        ("Identity (SHA-256)", data.get("identity")),
        ("Rating", ", ".join(f"{key} {_said(value)}" for key, value in method.items())),
        ("Training", ", ".join(f"{key} {_said(value)}" for key, value in train.items())),
        ("Robustness u of each policy", ", ".join(map(_said, _list(summary.get("u"))))),
        ("Versions", ", ".join(f"{key} {value}" for key, value in versions.items())),
        ("Command", run.get("command")),
    ]
    return [(name, str(value)) for name, value in pairs if value not in (None, "")]


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _said(value: Any) -> str:
    return number(value) if isinstance(value, float) else str(value)


def judged(rated: RatingsFolder) -> dict[str, Any]:
    """The verdict, agreement, calibration and findings of ``summary.json``.

    Raises:
        ValueError: if it is not what a rating writes there.
    """
    summary = rated.summary

    def wrong(key: str, needed: str) -> ValueError:
        file = str(rated.path / "summary.json")
        return ValueError(f"{key!r} of {file!r} is {summary.get(key)!r}, needed is {needed}: rate the data again")

    if not isinstance(summary.get("usable"), bool):
        raise wrong("usable", "true or false")
    if not isinstance(summary.get("sentence"), str):
        raise wrong("sentence", "a text")
    if not isinstance(summary.get("reasons", []), list):
        raise wrong("reasons", "a list of texts")
    agree = summary.get("agreement")
    if not isinstance(agree, dict) or not all(_number(agree.get(key, "")) for key in ("spearman", "low", "high")):
        raise wrong("agreement", "an object of spearman, low and high")
    shares = summary.get("calibration")
    if not isinstance(shares, dict) or not all(k.isdecimal() and _number(v) for k, v in shares.items()):
        raise wrong("calibration", "an object of decades and shares")
    findings = summary.get("findings") or []
    if not isinstance(findings, list) or not all(isinstance(finding, dict) for finding in findings):
        raise wrong("findings", "a list of objects")
    nan, texts = float("nan"), ("severity", "kind", "what", "where", "fix")
    return {
        "sentence": summary["sentence"],
        "reasons": rated.reasons,
        "agreement": {k: nan if agree[k] is None else float(agree[k]) for k in ("spearman", "low", "high")},
        "calibration": {int(key): float(share) for key, share in shares.items() if share is not None},
        "findings": [{key: str(finding.get(key) or "") for key in texts} for finding in findings],
    }


def _number(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))
