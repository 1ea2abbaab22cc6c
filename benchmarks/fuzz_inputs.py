"""What is fuzzed with data: whatever reads demonstrations, given some of which one entry is spoilt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from fuzz_table import _actor, _plain_loss, _recurrent, rows
from hypothesis import strategies as st
from tensordict import NonTensorData, TensorDict

import torchrl_tsallis as tt
from torchrl_tsallis import data as ttd

_KEYS = ["observation", "action", "is_init", "episode", ("next", "observation"), ("next", "done"), ("info", "episode")]
#: What may stand in the place of an entry of N rows.
_VALUES: dict[str, Callable[[torch.Tensor], Any]] = {
    "missing": lambda value: None,
    "NaN": lambda value: torch.full(value.shape, torch.nan),
    "infinite": lambda value: torch.full(value.shape, -torch.inf),
    "huge": lambda value: torch.full(value.shape, 3e38),
    "integers": lambda value: torch.ones(value.shape, dtype=torch.int64),
    "bytes": lambda value: torch.ones(value.shape, dtype=torch.uint8),
    "truths": lambda value: torch.ones(value.shape, dtype=torch.bool),
    "complex": lambda value: torch.ones(value.shape, dtype=torch.complex64),
    "doubles": lambda value: torch.ones(value.shape, dtype=torch.float64),
    "halves": lambda value: torch.ones(value.shape, dtype=torch.float16),
    "flat": lambda value: torch.ones(len(value)),
    "wider": lambda value: torch.ones(len(value), 7),
    "no width": lambda value: torch.ones(len(value), 0),
    "deeper": lambda value: torch.ones(len(value), 2, 3, 2),
    "nested": lambda value: TensorDict({"a": torch.ones(len(value), 2)}, [len(value)]),
    "nested, empty": lambda value: TensorDict({}, [len(value)]),
    "text": lambda value: NonTensorData("text", batch_size=[len(value)]),
    "gradient": lambda value: torch.ones(value.shape, requires_grad=True),
}
#: What may be done to the whole.
_WHOLES: dict[str, Callable[[TensorDict], Any]] = {
    "no rows": lambda data: data[:0],
    "one row": lambda data: data[:1],
    "a single step": lambda data: data[0],
    "two dimensions": lambda data: data.reshape(3, 4),
    "none": lambda data: None,
    "a dict": lambda data: data.to_dict(),
    "a list": lambda data: [data],
    "a tensor": lambda data: data["action"],
    "a number": lambda data: 3,
    "text": lambda data: "data",
    "empty": lambda data: TensorDict({}, []),
    "empty rows": lambda data: TensorDict({}, [12]),
}


#: Consumers in which the data reaches a network, whose own errors about it pass.
NETWORKS = tuple(
    f"data of {name}" for name in ("TsallisBCLoss", "TsallisBCLoss.rating", "PredictiveBCLoss", "RatedLoss")
)


class Spoilt(NamedTuple):
    """Data, what was done to it, and the names of which a message has to have one."""

    data: Any
    what: str
    names: tuple[str, ...]


def _entry(key: Any, how: str) -> Spoilt:
    data = rows()
    value = _VALUES[how](data[key])
    if value is None:
        data = data.exclude(key)
    else:
        data.set(key, value)
    leaf = key if isinstance(key, str) else key[-1]
    # Where one entry no longer fits another, either may be named.
    return Spoilt(data, f"{key} {how}", (leaf, "observation", "action", "demonstrations", "trajector", "episode"))


def mutations() -> st.SearchStrategy[Spoilt]:
    """Demonstrations of which one entry, or the whole, is spoilt."""
    names = (
        "demonstrations",
        "samples",
        "tensordict",
        "batch",
        "experts",
        "amateur",
        "observation",
        "action",
        "episode",
    )
    wholes = st.sampled_from(list(_WHOLES)).map(lambda how: Spoilt(_WHOLES[how](rows()), how, (*names, "trajector")))
    return st.one_of(st.builds(_entry, st.sampled_from(_KEYS), st.sampled_from(list(_VALUES))), wholes)


def consumers() -> dict[str, Callable[[Any], Any]]:
    """Whatever reads demonstrations, in this version of the package."""
    found: dict[str, Callable[[Any], Any]] = {
        "data of make_replay_buffer": lambda data: ttd.make_replay_buffer(data, batch_size=4).sample(),
        "data of make_sequence_buffer": lambda data: ttd.make_sequence_buffer(data, slice_len=4, num_slices=2).sample(),
        "data of make_stacked_replay_buffer": lambda data: ttd.make_stacked_replay_buffer(
            data, seeds=[0, 1], batch_size=4
        ).sample(),
        "data of validate_demonstrations": ttd.validate_demonstrations,
        "data of add_action_noise": ttd.add_action_noise,
        "data of replace_with_amateur": lambda data: ttd.replace_with_amateur(data, rows()),
        "data of split_trajectories": lambda data: ttd.split_trajectories(data, 0.5),
        "data of save_demonstrations": lambda data: ttd.save_demonstrations("file", data, {}),
        "data of Scaling.fit": lambda data: ttd.Scaling.fit(data, action_unit=1.0),
        "data of TsallisBCLoss": lambda data: tt.TsallisBCLoss(_actor())(data),
        "data of TsallisBCLoss.rating": lambda data: tt.TsallisBCLoss(_actor()).rating(data),
        "data of PredictiveBCLoss": lambda data: tt.PredictiveBCLoss(_recurrent())(
            data.reshape(3, 4) if isinstance(data, TensorDict) and data.shape == (12,) else data
        ),
    }
    if hasattr(ttd, "RobustScaling"):
        found["data of RobustScaling.fit"] = ttd.RobustScaling.fit
        found["data of inspect_demonstrations"] = ttd.inspect_demonstrations
        found["data of find_episodes"] = ttd.find_episodes
        found["data of fold_episodes"] = lambda data: ttd.fold_episodes(data, 2)
        found["data of replace_pairs"] = lambda data: ttd.replace_pairs(data, rows(), share=0.5)
        found["data of RatedLoss"] = lambda data: tt.RatedLoss(_plain_loss())(data)
    return found
