"""What demonstrations are: one schema, and the checks of it, which read the data in pieces.

Demonstrations are a flat tensordict ``[N]``, one row a time step, in TorchRL's episode format (TED):

===========================  ===================  ===========================================================
key                          shape                meaning
===========================  ===================  ===========================================================
``observation``              ``[N, *O]``          of any shape and dtype, or a nested tensordict of several
``action``                   ``[N, *A]``          ``[N]`` where it is one integer a step
``("next", "observation")``  ``[N, *O]``          optional
``("next", "reward")``       ``[N, 1]``           optional, for comparisons; training never reads it
``("next", "done")``         ``[N]``, ``[N, 1]``  the episode's last step; also ``terminated``, ``truncated``
``is_init``                  ``[N]``, ``[N, 1]``  the episode's first step
``episode``                  ``[N]``, ``[N, 1]``  number of the episode
``info``                     nested               labels and whatever else training must never read
===========================  ===================  ===========================================================

Rows of an episode follow one another. An episode ends where ``done``, ``terminated`` or ``truncated`` is set, where
``episode`` changes, before a row with ``is_init``, and at the last row. Each may be missing, but none may contradict
another. Without any of them the data is pairs: enough for a policy without memory, refused where episodes are needed.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, is_non_tensor, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_tsallis.data.rows import pieces, row_bytes

_log = logging.getLogger(__name__)


def _available(demonstrations: TensorDictBase) -> list[str]:
    return sorted(map(str, demonstrations.keys(True)))


def check_layout(demonstrations: TensorDictBase) -> int:
    """Raises for what is no flat tensordict of rows; returns their number N.

    Raises:
        TypeError: for another type.
        ValueError: for a batch size that is not ``[N]``, or a key with a dot.
    """
    if not isinstance(demonstrations, TensorDictBase):
        raise TypeError(
            f"demonstrations are a TensorDict of N rows, got {type(demonstrations).__name__}: "
            "TensorDict({'observation': ..., 'action': ...}, [N])"
        )
    if demonstrations.ndim != 1:
        raise ValueError(
            f"the demonstrations have the batch size {list(demonstrations.shape)}, needed is [N], one row a time step: "
            + ("TensorDict(..., [N])" if not demonstrations.ndim else "use demonstrations.reshape(-1)")
        )
    for key in demonstrations.keys(True):
        names = (key,) if isinstance(key, str) else key
        if any("." in name for name in names):
            raise ValueError(
                f"the key {key!r} has a dot, which files keep for nested keys: nest it, as "
                f"{tuple('.'.join(names).split('.'))!r}, by demonstrations.unflatten_keys('.')"
            )
    return len(demonstrations)


def leaves(demonstrations: TensorDictBase, keys: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
    """The tensors under the keys; those of a nested tensordict each by itself.

    Raises:
        KeyError: if a key is missing.
        TypeError: if what is under it is no tensor of numbers.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": {"state": torch.zeros(2, 3)}}, [2])
        >>> list(leaves(data, ["observation"]))
        [('observation', 'state')]
    """
    out: dict[NestedKey, Tensor] = {}
    for key in keys:
        value = demonstrations.get(key, None)
        if value is None:
            raise KeyError(f"the demonstrations have no {key!r}, only {_available(demonstrations)}")
        if is_tensor_collection(value) and not is_non_tensor(value):
            prefix = (key,) if isinstance(key, str) else tuple(key)
            nested = {(*prefix, *((k,) if isinstance(k, str) else k)): leaf for k, leaf in value.items(True, True)}
            if not nested:
                raise KeyError(f"{key!r} of the demonstrations is empty: it holds no tensor")
        else:
            nested = {key: value}
        for name, leaf in nested.items():
            _check_numbers(name, leaf)
        out.update(nested)
    return out


def _check_numbers(key: NestedKey, value: object) -> None:
    if not isinstance(value, Tensor) or value.is_complex():
        kind = str(value.dtype) if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{key!r} is {kind}, needed are real numbers: leave the entry out, or encode it as numbers")
    if 0 in value.shape[1:]:
        raise ValueError(f"{key!r} has shape {list(value.shape)}: it holds no number a row")


def bad_rows(value: Tensor) -> tuple[int, list[int]]:
    """Counts the rows of ``[N, *]`` that are NaN or infinite, and gives the first five."""
    count = 0
    first: list[int] = []
    if value.is_floating_point():
        for part in pieces(len(value), row_bytes(value)):
            finite = value[part].isfinite()
            rows = (~finite.flatten(1).all(1) if finite.ndim > 1 else ~finite).nonzero()[:, 0]
            count += len(rows)
            first += (part.start + rows[: 5 - len(first)]).tolist()
    return count, first


def check_rows(
    demonstrations: TensorDictBase,
    keys: Sequence[NestedKey],
    *,
    least: int = 1,
    whole_episodes: bool = False,
    before: int = 0,
    total: int | None = None,
) -> dict[NestedKey, Tensor]:
    """Raises for what cannot be trained on, and names key and rows.

    Args:
        demonstrations: flat ``[N]``.
        keys: the entries that training reads; nested ones stand for what is in them.
        least: fewest rows.
        whole_episodes: whether a bad row spoils its episode; changes the message alone.
        before: rows of other demonstrations before these, where they are stored together; counted in the message.
        total: rows of all of them. Default: those of these.

    Returns:
        The tensors under the keys.

    Raises:
        KeyError: if a key is missing.
        TypeError: if what is under it is no tensor of numbers.
        ValueError: if there are too few rows, or some are NaN or infinite.

    Examples:
        >>> from tensordict import TensorDict
        >>> check_rows(TensorDict({"action": torch.tensor([0.0, torch.nan])}, [2]), ["action"])
        Traceback (most recent call last):
        ...
        ValueError: 'action' is NaN or infinite in 1 of 2 rows, first [1]: remove those rows
    """
    size = check_layout(demonstrations)
    if not size:
        raise ValueError("the demonstrations are empty: there is no row")
    if size < least:
        raise ValueError(f"{size} samples are fewer than a batch of {least}: record more, or lower batch_size")
    found = leaves(demonstrations, keys)
    for key, value in found.items():
        count, first = bad_rows(value)
        if count:
            rows, fix = (
                (f"{count}", "their trajectory") if whole_episodes else (f"{count} of {total or size}", "those rows")
            )
            first = [before + row for row in first]
            raise ValueError(f"{key!r} is NaN or infinite in {rows} rows, first {first}: remove {fix}")
    return found


def check_pairs(demonstrations: TensorDictBase, *, action_limit: float | None = None) -> None:
    """Checks ``observation`` and ``action``; see :func:`~torchrl_tsallis.data.validate_demonstrations`."""
    size = check_layout(demonstrations)
    if size < 2:
        raise ValueError(f"{size} samples cannot be imitated: record at least two")
    found = leaves(demonstrations, ["observation", "action"])
    for key, value in found.items():
        if value.ndim == 1 and value.is_floating_point():
            raise ValueError(
                f"{key!r} has shape {list(value.shape)}, needed is [{size}, dimension]: give it a dimension by "
                "unsqueeze(-1), or make it integers if it is a choice"
            )
    dtypes = {key: value.dtype for key, value in found.items() if value.is_floating_point()}
    check_rows(demonstrations, ["observation", "action"])
    for key, value in found.items():
        constant = constant_dimensions(value)
        if constant:
            warnings.warn(f"{key!r} never changes in dimensions {constant}", stacklevel=3)
    if len(set(dtypes.values())) > 1:
        raise TypeError(f"mixed dtypes {dtypes}: convert the data by demonstrations.float()")
    if torch.float64 in dtypes.values():
        _log.warning(
            "%s are float64 and policies float32: make_offline_trainer converts batches; elsewhere use "
            "make_replay_buffer(..., dtype=torch.float32)",
            " and ".join(map(repr, dtypes)),
        )
    if action_limit is not None:
        _check_limit(found, size, action_limit)


def constant_dimensions(value: Tensor) -> list[int]:
    """Dimensions of vectors ``[N, D]`` whose rows are all the same; none for images, choices and flags."""
    if value.ndim != 2 or not value.is_floating_point():
        return []
    same = torch.ones(value.shape[1], dtype=torch.bool)
    for part in pieces(len(value), row_bytes(value)):
        same &= (value[part] == value[0]).all(0)
    return same.nonzero()[:, 0].tolist()


def _check_limit(found: dict[NestedKey, Tensor], size: int, limit: float) -> None:
    """Raises for actions outside of ``[-limit, limit]``."""
    for key, value in found.items():
        if (key if isinstance(key, str) else key[0]) != "action":
            continue
        count = 0
        first: list[int] = []
        for part in pieces(len(value), row_bytes(value)):
            rows = (value[part].abs() > limit).reshape(part.stop - part.start, -1).any(1).nonzero()[:, 0]
            count += len(rows)
            first += (part.start + rows[: 5 - len(first)]).tolist()
        if count:
            raise ValueError(
                f"{key!r} is outside of [-{limit}, {limit}] in {count} of {size} rows, first {first}: clip the "
                "executed action, record it in the space's units, or raise action_limit"
            )
