"""What says that a demonstration is bad, and how well: the scores of recipes/curation.py and their quality."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

from torchrl_tsallis.data import RobustScaling
from torchrl_tsallis.data.episodes import find_episodes
from torchrl_tsallis.data.signals import episode_signals, knn_residual, mutual_information
from torchrl_tsallis.evaluation import auroc
from torchrl_tsallis.run import default_steps
from torchrl_tsallis.runs.held_out import hold_out
from torchrl_tsallis.runs.judgement import spearman
from torchrl_tsallis.runs.members import make_splits, train_members

#: Scores of samples, large where one is suspicious.
SAMPLES = ("surprise", "surprise_seen", "rejection", "knn_residual", "deminf")


def rated(data: Any, *, seed: int, folds: int, steps: int | None) -> dict[str, np.ndarray]:
    """Scores of samples, ``samples/...`` ``[N]``, and of episodes, by their names ``[E]``; large where suspicious.

    Args:
        data: ``observation``, ``action`` and what tells the episodes.
        seed: of the folds and the policies.
        folds: of the policies, each of which does not see one.
        steps: of their training. Default: what ``tsallis rate`` takes.
    """
    splits = make_splits(data, seeds=1, folds=folds)
    splits = [type(split)(seed, split.held_out) for split in splits]
    members = train_members(data, splits, steps=steps or default_steps(len(data)), batch_size=256)
    found = hold_out(members, data, splits, 1)
    episodes = find_episodes(data, open_end=True)
    scaled = RobustScaling.fit(data)(data.select("observation", "action"))
    observation, action = scaled["observation"], scaled["action"]
    samples = {
        "surprise": found.surprise[0].clamp(max=12.0),
        "surprise_seen": found.seen.clamp(max=12.0),
        "rejection": 1.0 - found.rating[0],
        "knn_residual": knn_residual(observation, action, episodes),
        "deminf": -mutual_information(observation, action),
    }
    number = episodes.of_rows()
    out = {f"samples/{name}": value.float().numpy() for name, value in samples.items()}
    for name in ("surprise", "surprise_seen", "rejection"):
        total = torch.zeros(len(episodes.starts), dtype=torch.float64).index_add_(0, number, samples[name].double())
        out[name] = (total / episodes.lengths).numpy()
    signals = {name: value.double().numpy() for name, value in episode_signals(data).items()}
    signals["deminf"] = -signals["deminf"]
    for name in ("path_length", "steps"):  # bad may be short or long
        signals[f"unusual_{name}"] = np.abs(signals[name] - np.median(signals[name]))
    return out | signals | {"episode_of_rows": number.numpy()}


def _episode_scores(scores: Mapping[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    named = {"surprise", "surprise_seen", "rejection", "knn_residual", "deminf", "jerk", "still_share"}
    paper = [name for name in scores if name.startswith("rejection_")]
    for name in (*sorted(named), *paper, "unusual_path_length", "unusual_steps"):
        yield name, scores[name]


def of_labels(scores: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """AUROC of the scores for the labels: of samples, and of episodes that are an amateur's from end to end."""
    rows = []
    count = len(scores["surprise"])
    for label in ("is_noise", "is_amateur"):
        bad = np.asarray(scores.get(label, False)).astype(bool)
        if not bad.any():
            continue
        of_samples = [name.removeprefix("samples/") for name in scores if name.startswith("samples/rejection_")]
        for name in (*SAMPLES, *of_samples):
            value = scores[f"samples/{name}"]
            rows.append({"score": name, "label": label, "level": "sample", "auroc": auroc(value[bad], value[~bad])})
        episodes = bad.reshape(count, -1)
        whole = episodes.all(1)
        if whole.any() and (whole == episodes.any(1)).all():
            for name, value in _episode_scores(scores):
                quality = auroc(value[whole], value[~whole]) if np.ptp(value) else 0.5
                rows.append({"score": name, "label": label, "level": "episode", "auroc": quality})
    return rows


def of_human(scores: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """AUROC of the scores for the half of the episodes with the lower return, alone and controlled for length.

    Controlled: both ranks are replaced by what a line through the length's ranks leaves of them.
    """
    totals = scores["ep_return"]
    bad = totals < np.median(totals)
    rows = []
    for name, value in _episode_scores(scores):
        for level, one in (("episode", value), ("episode, length controlled", _without(value, scores["steps"]))):
            quality = auroc(one[bad], one[~bad]) if np.ptp(one) else 0.5
            rows.append({"score": name, "label": "low_return", "level": level, "auroc": quality})
        rows.append({"score": name, "label": "return", "level": "rank", "auroc": (1 - spearman(value, totals)) / 2})
    return rows


def _without(value: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The ranks of values without what the ranks of lengths explain of them."""
    from torchrl_tsallis.runs.judgement import ranks

    x, y = ranks(length) - (len(length) - 1) / 2, ranks(value) - (len(value) - 1) / 2
    return y - x * (x @ y) / max(x @ x, 1e-12)
