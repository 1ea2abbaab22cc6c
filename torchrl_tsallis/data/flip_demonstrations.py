"""Recording of page flipping by the scripted operator, and the replay of recorded forces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_tsallis._checks import check_callable, check_number, check_seed, shown
from torchrl_tsallis.data.teleoperation import FlipOperator, Stroke, Style
from torchrl_tsallis.envs.flips import FlipCount, count_flips

#: Faults of the operator, under ``("info", ...)``; training never reads them.
FAULTS = ("off_target", "hesitation", "missed", "multiple")


def label_faults(strokes: list[Stroke], begins: list[int], flips: FlipCount, steps: int) -> dict[str, np.ndarray]:
    """Finds the faulty stretches of a trajectory.

    A page belongs to the stroke that last began to lift before it turned over. A stroke that the trajectory's end cuts
    off before its release is not blamed for missing.

    Args:
        strokes: of the operator.
        begins: step at which each began.
        flips: what was flipped; its steps count from the first observation.
        steps: of the trajectory.

    Returns:
        ``off_target`` (strokes aimed beside the page), ``hesitation`` (pauses), ``missed`` (strokes that turned no
        page) and ``multiple`` (strokes that turned several), each ``[steps]`` bool.
    """
    labels = {name: np.zeros(steps, dtype=bool) for name in FAULTS}
    lifts = np.array([begin + stroke.lift for stroke, begin in zip(strokes, begins, strict=True)])
    owner = np.searchsorted(lifts, flips.steps, side="left") - 1
    for k, (stroke, begin) in enumerate(zip(strokes, begins, strict=True)):
        span = slice(begin, begin + len(stroke.path))
        turned = int((owner == k).sum())
        labels["off_target"][span] = stroke.off_target
        labels["hesitation"][span] = stroke.pause[: max(0, steps - begin)]
        labels["missed"][span] = turned == 0 and begin + stroke.release < steps
        labels["multiple"][span] = turned > 1
    return labels


def record_flips(
    make_env: Callable[[], Any], *, seed: int, steps: int = 500, style: Style | None = None
) -> tuple[TensorDict, dict[str, Any]]:
    """Lets the operator flip pages, and records the follower.

    Args:
        make_env: makes the environment, see :func:`~torchrl_tsallis.envs.page_flip.make_page_flip`.
        seed: of the environment and the operator.
        steps: to record, 500 of 20 ms.
        style: habits of the operator. Default: drawn from the seed.

    Returns:
        The pairs, ``[steps]``: ``observation`` and ``("next", "observation")`` ``[12]`` in m and N, ``action`` ``[3]``
        in N, ``is_init``, ``("next", "done" | "terminated" | "truncated")`` ``[1]`` of a trajectory that is truncated
        at its end, and under ``info`` the faults, their union ``is_noise``, the free edges' angles ``[10]`` in rad and
        the contact force ``[3]`` in N; and the facts: ``seed``, ``flips``, ``sizes`` of the events, ``strokes``, and
        the numbers of strokes that are ``missed`` and ``multiple``.
    """
    check_callable("make_env", make_env, "makes the environment")
    seed, steps = check_seed("seed", seed, low=0), int(check_number("steps", steps, low=1, integer=True))
    env = make_env()
    if not hasattr(env, "reset"):
        raise TypeError(f"make_env must make an environment of gymnasium, it made {shown(env)}")
    observation, info = env.reset(seed=seed)
    operator = FlipOperator(seed, style)
    rows: list[tuple[np.ndarray, ...]] = []
    angles = [info["edge_angles"]]
    for _ in range(steps):
        action = operator.act(observation, info["edges"])
        following, _, _, _, info = env.step(action)
        rows.append((observation, action, following, info["contact_force"].astype(np.float32)))
        angles.append(info["edge_angles"])
        observation = following
    env.close()
    history = np.stack(angles)
    flips = count_flips(history)
    labels = label_faults(operator.strokes, operator.begins, flips, steps)
    before, actions, after, contact = (torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))
    flags = {name: torch.zeros(steps, 1, dtype=torch.bool) for name in ("is_init", "done", "terminated", "truncated")}
    flags["is_init"][0] = flags["done"][-1] = flags["truncated"][-1] = True
    side: dict[str, Any] = {name: torch.from_numpy(label) for name, label in labels.items()}
    side["is_noise"] = torch.stack(list(side.values())).any(0)
    side["edge_angles"] = torch.from_numpy(history[:-1].astype(np.float32))
    side["contact_force"] = contact
    following_ = {"observation": after} | {name: flags[name] for name in ("done", "terminated", "truncated")}
    data = {"observation": before, "action": actions, "is_init": flags["is_init"]}
    data |= {"next": TensorDict(following_, [steps]), "info": TensorDict(side, [steps])}
    per_stroke = {name: _count_strokes(operator, labels[name]) for name in ("missed", "multiple", "off_target")}
    facts = {"seed": seed, "flips": flips.total, "sizes": flips.sizes.tolist(), "strokes": len(operator.strokes)}
    return TensorDict(data, [steps]), facts | per_stroke


def _count_strokes(operator: FlipOperator, label: np.ndarray) -> int:
    return int(label[operator.begins].sum())


def replay_forces(make_env: Callable[[], Any], forces: torch.Tensor, *, seed: int) -> tuple[np.ndarray, FlipCount]:
    """Exerts recorded forces again, from the same start.

    Args:
        make_env: makes the environment.
        forces: the recorded actions, ``[T, 3]`` in N.
        seed: of the recording.

    Returns:
        The observations after each force, ``[T, 12]``, and what was flipped.
    """
    check_callable("make_env", make_env, "makes the environment")
    if not isinstance(forces, torch.Tensor) or forces.ndim != 2:
        raise TypeError(f"forces must be a tensor [T, 3], got {shown(forces)}")
    env = make_env()
    if not hasattr(env, "reset"):
        raise TypeError(f"make_env must make an environment of gymnasium, it made {shown(env)}")
    _, info = env.reset(seed=check_seed("seed", seed, low=0))
    angles, observations = [info["edge_angles"]], []
    for force in forces.numpy():
        observation, _, _, _, info = env.step(force)
        angles.append(info["edge_angles"])
        observations.append(observation)
    env.close()
    return np.stack(observations), count_flips(np.stack(angles))
