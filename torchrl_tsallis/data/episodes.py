"""Where episodes begin and end: the one function that buffers, splits, checks and readers ask."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis.data.schema import bad_rows, check_layout

#: Flags of an episode's last step.
ENDS: tuple[NestedKey, ...] = (("next", "done"), ("next", "terminated"), ("next", "truncated"))
#: Flag of its first step, its number, and a label that is read only where nothing else is there.
IS_INIT, EPISODE, LABEL = "is_init", "episode", ("info", "episode")
_STEP = 2**20  # rows looked at together


class Episodes(NamedTuple):
    """Where the episodes are.

    Args:
        starts: first row of each, ``[E]``.
        lengths: rows of each, ``[E]``.
    """

    starts: Tensor
    lengths: Tensor

    @property
    def ends(self) -> Tensor:
        """Last row of each, ``[E]``."""
        return self.starts + self.lengths - 1

    def of_rows(self) -> Tensor:
        """Number of each row's episode, ``[N]``."""
        return torch.arange(len(self.starts)).repeat_interleave(self.lengths)


def read_flag(demonstrations: TensorDictBase, key: NestedKey) -> Tensor | None:
    """A flag as ``[N]``, in its own dtype, or None where there is none.

    Raises:
        ValueError: if its shape is not ``[N]`` or ``[N, 1]``, or it holds other values than true and false.
    """
    value = demonstrations.get(key, None)
    if value is None:
        return None
    size = len(demonstrations)
    if not isinstance(value, Tensor) or value.shape not in ((size,), (size, 1)):
        shape = list(getattr(value, "shape", []))
        raise ValueError(f"{key!r} has shape {shape}, needed is [{size}] or [{size}, 1]: one value a row")
    return value.reshape(-1)


def _true(key: NestedKey, value: Tensor, part: slice) -> Tensor:
    rows = value[part]
    if rows.dtype == torch.bool:
        return rows
    other = ((rows != 0) & (rows != 1)).nonzero()[:, 0]
    if len(other):
        row = int(other[0])
        raise ValueError(f"{key!r} is {rows[row].item()} at row {part.start + row}, needed are flags: true or false")
    return rows != 0


def has_episodes(demonstrations: TensorDictBase) -> bool:
    """Whether anything tells where episodes end."""
    return any(demonstrations.get(key, None) is not None for key in (*ENDS, IS_INIT, EPISODE, LABEL))


def _contradiction(wrong: Tensor, start: int, says: str, but: str) -> None:
    rows = (start + wrong.nonzero()[:, 0]).tolist()
    if rows:
        raise ValueError(
            f"the ends of episodes contradict one another: {says} after {len(rows)} rows, first {rows[:5]}, but {but}: "
            "correct one of the two, or leave it out"
        )


def find_episodes(demonstrations: TensorDictBase, *, purpose: str = "this", open_end: bool = False) -> Episodes:
    """Finds where the episodes are, see :mod:`torchrl_tsallis.data.schema`.

    Args:
        demonstrations: flat ``[N]``, episodes one after the other.
        purpose: what needs the episodes, for the message.
        open_end: whether the last episode may lack its end, as a recording that was cut does.

    Returns:
        First row and length of each episode, in the recorded order.

    Raises:
        ValueError: if nothing tells where episodes end, if two entries contradict each other, if the last row's flags
            say that its episode goes on, or if rows of an episode are not together; the message names rows.

    Examples:
        >>> from tensordict import TensorDict
        >>> find_episodes(TensorDict({"episode": torch.tensor([4, 4, 7])}, [3]))
        Episodes(starts=tensor([0, 2]), lengths=tensor([2, 1]))
    """
    size = check_layout(demonstrations)
    if not size:
        raise ValueError("the demonstrations are empty: there is no row")
    flags = {key: flag for key in ENDS if (flag := read_flag(demonstrations, key)) is not None}
    init, number = read_flag(demonstrations, IS_INIT), read_flag(demonstrations, EPISODE)
    key_of_number: NestedKey = EPISODE
    if not flags and init is None and number is None:
        number, key_of_number = read_flag(demonstrations, LABEL), LABEL
        if number is None:
            raise ValueError(
                f"the demonstrations are pairs without episodes, which {purpose} needs: add the number of each row's "
                f"episode, {EPISODE!r} [{size}], or flags ('next', 'done') at each last step"
            )
    if number is not None and bad_rows(number)[0]:
        raise ValueError(f"{key_of_number!r} is NaN or infinite at row {bad_rows(number)[1][0]}: number the episodes")
    named = " or ".join(repr(key) for key in flags)
    ends: list[Tensor] = []
    last_flag = False
    for start in range(0, size, _STEP):
        part = slice(start, min(size, start + _STEP))
        inner = min(part.stop, size - 1) - start  # rows with a following one
        following = slice(start + 1, start + 1 + inner)
        end = torch.zeros(part.stop - start, dtype=torch.bool)
        for key, flag in flags.items():
            end |= _true(key, flag, part)
        last_flag = bool(end[-1])
        flagged = end[:inner].clone()
        begins = None if init is None else _true(IS_INIT, init, following)
        if init is not None and part.start == 0:
            _true(IS_INIT, init, slice(0, 1))
        changes = None if number is None else number[following] != number[start : start + inner]
        if flags and begins is not None:
            _contradiction(flagged & ~begins, start, f"{named} ends an episode", f"{IS_INIT!r} does not begin one")
        if flags and changes is not None:
            _contradiction(flagged & ~changes, start, f"{named} ends an episode", f"{key_of_number!r} goes on")
        if begins is not None and changes is not None:
            _contradiction(begins & ~changes, start, f"{IS_INIT!r} begins an episode", f"{key_of_number!r} goes on")
            _contradiction(changes & ~begins, start, f"{key_of_number!r} changes", f"{IS_INIT!r} does not begin one")
        for more in (begins, changes):
            if more is not None:
                end[:inner] |= more
        if part.stop == size:
            end[-1] = True
        ends.append(start + end.nonzero()[:, 0])
    if flags and not last_flag and number is None and not open_end:
        raise ValueError("the last trajectory has no end: set ('next', 'done') at its last step")
    stops = torch.cat(ends) + 1
    lengths = torch.diff(stops, prepend=stops.new_zeros(1))
    found = Episodes(stops - lengths, lengths)
    if number is not None:
        _check_runs(number, found, key_of_number)
    return found


def _check_runs(number: Tensor, found: Episodes, key: NestedKey) -> None:
    """Raises if a number stands in two runs of rows."""
    names = number[found.starts]
    order = names.argsort(stable=True)
    again = (names[order][1:] == names[order][:-1]).nonzero()[:, 0]
    if len(again):
        first, second = order[again[0]], order[again[0] + 1]
        raise ValueError(
            f"episode {names[first].item()} of {key!r} stands in two runs of rows, from row {int(found.starts[first])} "
            f"and again from row {int(found.starts[second])}: keep the rows of an episode together, and give each "
            "episode a number of its own"
        )
