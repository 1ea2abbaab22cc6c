"""Checks of how rows follow one another: copies, lengths, stillness, boundaries, times."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis.data.episodes import Episodes
from torchrl_tsallis.data.findings import Finding, named, text, vectors, within
from torchrl_tsallis.data.robust_scaling import robust_statistics
from torchrl_tsallis.data.rows import pieces, row_bytes
from torchrl_tsallis.data.schema import leaves


def _marks(values: Sequence[Tensor]) -> Tensor:
    """A number for each row, the same for the same bits, ``[N]`` int64."""
    size = len(values[0])
    marks = torch.zeros(size, dtype=torch.int64)
    generator = torch.Generator().manual_seed(0)
    for value in values:
        width = value[0].contiguous().view(-1).view(torch.uint8).numel()
        weights = torch.randint(-(2**62), 2**62, (width,), generator=generator)
        for part in pieces(size, 8 * width):  # a byte becomes an int64
            rows = value[part].contiguous().reshape(part.stop - part.start, -1).view(torch.uint8)
            marks[part] = marks[part] * 31 + (rows.long() * weights).sum(1)
    return marks


def _again(marks: Tensor) -> tuple[Tensor, Tensor]:
    """Places whose mark stood before, in ascending order, and where it stood first."""
    order = marks.argsort(stable=True)
    new = torch.ones(len(marks), dtype=torch.bool)
    new[1:] = marks[order][1:] != marks[order][:-1]
    first = order[new.nonzero()[:, 0]][new.cumsum(0) - 1]
    again, sort = order[~new].sort()
    return again, first[~new][sort]


def find_copies(
    demonstrations: TensorDictBase, keys: Sequence[NestedKey], episodes: Episodes | None = None
) -> list[Finding]:
    """Rows whose entries stand in an earlier row too, and whole episodes that do.

    Args:
        demonstrations: flat ``[N]``.
        keys: entries that must all be the same.
        episodes: of the rows. Default: none.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"action": torch.tensor([[1.0], [2.0], [1.0]])}, [3])
        >>> find_copies(data, ["action"])[0].rows
        (2,)
    """
    values = list(leaves(demonstrations, keys).values()) if keys else []
    if not values:
        return []
    marks = _marks(values)
    again, _ = _again(marks)
    out = []
    if len(again):
        what = f"{len(again)} of {len(marks)} rows are exact copies of earlier ones"
        fix = "where the robot stood still that is so; otherwise remove what was recorded or joined twice"
        severity = "warning" if len(again) > 0.01 * len(marks) else "note"
        out.append(Finding(severity, "copied_rows", what, fix, count=len(again), rows=named(again.tolist())))  # type: ignore[arg-type]
    if episodes is None or len(episodes.starts) < 2:
        return out
    # An episode's mark depends on the order of its rows; episodes of other lengths differ.
    step = torch.arange(len(marks)) - episodes.starts.repeat_interleave(episodes.lengths)
    mixed = (marks ^ (marks >> 29)) * (2 * step + 2**33 + 1)
    total = torch.zeros(len(episodes.starts), dtype=torch.int64).index_add_(0, episodes.of_rows(), mixed)
    copies, originals = _again(total * 1_000_003 + episodes.lengths)
    if len(copies):
        pairs = ", ".join(f"{b} of {a}" for a, b in zip(originals[:5].tolist(), copies[:5].tolist(), strict=True))
        what = f"{len(copies)} of {len(total)} episodes are exact copies of earlier ones: {pairs}"
        fix = "remove the copies: they count twice, and may stand on both sides of a split"
        found = named(copies.tolist())
        out.append(Finding("error", "copied_episodes", what, fix, count=len(copies), episodes=found))
    return out


def find_lengths(episodes: Episodes) -> list[Finding]:
    """Episodes of one step, and those of less than a tenth of the median length."""
    lengths, out = episodes.lengths, []
    single = (lengths == 1).nonzero()[:, 0].tolist()
    if single:
        what = f"{len(single)} of {len(lengths)} episodes have one step"
        fix = "remove them, or check the flags that end episodes"
        out.append(Finding("warning", "length_one", what, fix, count=len(single), episodes=named(single)))
    median = lengths.median().item()
    short = ((lengths > 1) & (10 * lengths < median)).nonzero()[:, 0].tolist()
    if short:
        what = f"{len(short)} of {len(lengths)} episodes are shorter than a tenth of the median of {median} steps"
        fix = "look at them: recordings that were broken off"
        out.append(Finding("note", "short", what, fix, count=len(short), episodes=named(short)))
    return out


def _steps(demonstrations: TensorDictBase, keys: Sequence[NestedKey]) -> Tensor | None:
    """Greatest change of any dimension from each row to the next, in its scale, ``[N - 1]``; None without vectors."""
    found = vectors(demonstrations, keys) if keys else {}
    size = len(demonstrations)
    if not found or size < 2:
        return None
    out = torch.zeros(size - 1)
    for value in found.values():
        _, scale = robust_statistics(value)
        for part in pieces(size - 1, row_bytes(value)):
            change = (value[part.start + 1 : part.stop + 1].double() - value[part]).abs() / scale
            out[part] = torch.maximum(out[part], change.amax(1).float())
    return out


def find_still(
    demonstrations: TensorDictBase,
    keys: Sequence[NestedKey],
    episodes: Episodes,
    *,
    least: int = 10,
    tolerance: float = 1e-3,
) -> list[Finding]:
    """Stretches in which no dimension of the observation changes.

    Args:
        demonstrations: flat ``[N]``.
        keys: vectors to look at.
        episodes: of the rows.
        least: steps of a stretch (10).
        tolerance: greatest change a step, in the dimension's robust scale (0.001).
    """
    steps = _steps(demonstrations, keys)
    if steps is None:
        return []
    still = (steps <= tolerance) & within(episodes.lengths)
    edge = torch.diff(still.int(), prepend=torch.zeros(1, dtype=torch.int32), append=torch.zeros(1, dtype=torch.int32))
    begins, ends = (edge == 1).nonzero()[:, 0], (edge == -1).nonzero()[:, 0]
    long = (ends - begins) >= least
    begins, ends = begins[long], ends[long]
    if not len(begins):
        return []
    total = int((ends - begins).sum())
    what = (
        f"the observation stands still for {least} steps or more in {len(begins)} stretches, {total} of "
        f"{len(demonstrations)} steps"
    )
    touched = torch.searchsorted(episodes.starts, begins, right=True).sub(1).unique()
    fix = "cut waiting at the beginning and the end: the policy learns to wait"
    severity = "warning" if total > 0.05 * len(demonstrations) else "note"
    return [
        Finding(severity, "still", what, fix, _names(keys), total, named(begins), episodes=named(touched))  # type: ignore[arg-type]
    ]


def _names(keys: Sequence[NestedKey]) -> str:
    return ", ".join(map(text, keys))


def find_boundaries(
    demonstrations: TensorDictBase, keys: Sequence[NestedKey], episodes: Episodes, *, times: float = 10.0
) -> list[Finding]:
    """Episodes that jump within, and episodes that go on where the one before ended.

    A jump is a step of more than ``times`` the 99 % quantile of all steps within episodes, and as large as half of
    those from one episode to the next. Episodes go on where the step to the next one is no larger than the 90 %
    quantile of those within, in more than half of the cases.

    Args:
        demonstrations: flat ``[N]``.
        keys: vectors to look at.
        episodes: of the rows.
        times: see above (10).
    """
    steps = _steps(demonstrations, keys)
    inside = within(episodes.lengths)
    if steps is None or not inside.any():
        return []
    own, between = steps[inside], steps[~inside]
    ordered = own.sort().values
    usual, large = (float(ordered[round(share * (len(ordered) - 1))]) for share in (0.9, 0.99))
    least = max(times * large, float(between.median()) if len(between) else 0.0)
    out = []
    jumps = ((steps > least) & inside).nonzero()[:, 0] if least > 0 else steps.new_zeros(0)
    if len(jumps):
        touched = torch.searchsorted(episodes.starts, jumps.long(), right=True).sub(1).unique()
        what = f"the observation jumps within {len(touched)} episodes, after {len(jumps)} rows"
        fix = "look at the rows: two recordings may have been joined, or frames lost"
        rows, where = named(jumps), named(touched)
        out.append(Finding("warning", "jump", what, fix, _names(keys), len(jumps), rows, episodes=where))
    if len(between) >= 2 and usual > 0 and (between <= usual).float().mean() > 0.5:
        what = f"{int((between <= usual).sum())} of {len(between)} episodes begin where the one before ended"
        fix = "check what ends an episode: one recording may have been cut into pieces"
        out.append(Finding("warning", "continued", what, fix, _names(keys), int((between <= usual).sum())))
    return out


def find_time_jumps(timestamps: Tensor, episodes: Episodes, *, tolerance: float = 0.5) -> list[Finding]:
    """Rows after which time goes back, stands still, or jumps within an episode.

    Args:
        timestamps: in s, ``[N]`` or ``[N, 1]``.
        episodes: of the rows.
        tolerance: of a step's duration, as a share of the median one (0.5).

    Raises:
        ValueError: if there is not one time a row.

    Examples:
        >>> episodes = Episodes(torch.tensor([0]), torch.tensor([5]))
        >>> find_time_jumps(torch.tensor([0.0, 0.1, 0.2, 0.6, 0.7]), episodes)[0].rows
        (2,)
    """
    time = timestamps.reshape(-1).double()
    size = int(episodes.lengths.sum())
    if len(time) != size:
        raise ValueError(f"{len(time)} timestamps for {size} rows: give one a row")
    inside = within(episodes.lengths)
    duration = time.diff()
    if not inside.any():
        return []
    median = float(duration[inside].median())
    bad = inside & ~((duration > 0) & ((duration - median).abs() <= tolerance * abs(median)))
    rows = bad.nonzero()[:, 0]
    if not len(rows):
        return []
    touched = torch.searchsorted(episodes.starts, rows, right=True).sub(1).unique()
    what = f"time goes back, stands still or jumps after {len(rows)} rows; a step takes {median:.4g} s"
    fix = "frames were lost or written twice: record these episodes again, or remove them"
    return [Finding("warning", "time", what, fix, "info.timestamp", len(rows), named(rows), episodes=named(touched))]
