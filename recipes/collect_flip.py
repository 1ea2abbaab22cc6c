"""Records the page flipping demonstrations: 60 trajectories of 10 s at 50 Hz, 30,000 pairs.

A scripted operator with human-like faults stands for the person at the leader arm::

    python recipes/collect_flip.py seed=0 output=outputs/flip_data
"""

from __future__ import annotations

import hashlib
import json
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from options import check_options, count, one_seed
from tensordict import TensorDict

from torchrl_tsallis.data import flip_demonstrations, load_demonstrations, save_demonstrations, teleoperation
from torchrl_tsallis.data.flip_demonstrations import FAULTS, record_flips, replay_forces
from torchrl_tsallis.envs import _arm, _flip_world, _notebook, count_flips, flips, make_page_flip, page_flip
from torchrl_tsallis.evaluation import record_rollout
from torchrl_tsallis.evaluation.flip_plots import force_over_time
from torchrl_tsallis.jobs import run_jobs, tick

SOURCES = (_arm, _notebook, _flip_world, page_flip, flips, teleoperation, flip_demonstrations)


def record(job: tuple[int, int], steps: int, replay: bool) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Records one trajectory, in a worker process; as arrays, because each shared tensor would hold a file open."""
    episode, seed = job
    torch.set_num_threads(1)
    data, facts = record_flips(make_page_flip, seed=seed, steps=steps)
    data["info", "episode"] = torch.full((steps,), episode)
    if replay:
        observations, again = replay_forces(make_page_flip, data["action"], seed=seed)
        error = np.abs(observations - data["next", "observation"].numpy())[:, :3].max()
        facts |= {"replayed": again.total, "replay_error": float(error)}
    tick()
    return {key: value.numpy() for key, value in data.flatten_keys(".").items()}, facts


def collect_flips(
    output: str | Path,
    *,
    trajectories: int = 60,
    seed: int = 0,
    steps: int = 500,
    workers: int = 2,
    replay: bool = True,
    progress: bool = True,
) -> tuple[TensorDict, dict[str, Any]]:
    """Loads the demonstrations, and records them where they are missing.

    Args:
        output: folder of the recording; the file's name holds the settings and a hash of the simulator's source.
        trajectories: to record.
        seed: of the recording.
        steps: pairs a trajectory, 20 ms each.
        workers: processes.
        replay: whether the recorded forces are exerted again, to compare.
        progress: whether to show a bar.

    Returns:
        The demonstrations, ``[trajectories * steps]``, see
        :func:`~torchrl_tsallis.data.flip_demonstrations.record_flips`, and the facts of each trajectory.
    """
    digest = hashlib.sha256(b"".join(Path(str(module.__file__)).read_bytes() for module in SOURCES)).hexdigest()[:12]
    file = Path(output) / f"flip_n{trajectories}_seed{seed}_steps{steps}_{digest}.safetensors"
    if not file.exists():
        jobs = [(i, 100_000 * (seed + 1) + i) for i in range(trajectories)]
        bar = {"total": len(jobs), "desc": "recording", "unit": "trajectory", "progress": progress}
        results = run_jobs(partial(record, steps=steps, replay=replay), jobs, workers=workers, **bar)
        parts, facts = zip(*results, strict=True)
        metadata = {"seed": seed, "steps": steps, "rate_hz": 50, "trajectories": facts}
        columns = {key: torch.from_numpy(np.concatenate([part[key] for part in parts])) for key in parts[0]}
        data = TensorDict(columns, [trajectories * steps]).unflatten_keys(".")
        save_demonstrations(file, data, metadata)
    return load_demonstrations(file)


def summarise(data: TensorDict, facts: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the whole recording."""
    pages = np.array([fact["flips"] for fact in facts])
    sizes = np.concatenate([fact["sizes"] for fact in facts])
    norm = data["action"].norm(dim=1)
    summary: dict[str, Any] = {
        "pairs": len(data),
        "pages": int(pages.sum()),
        "pages_per_trajectory_mean_min_max": {
            "mean": round(float(pages.mean()), 2),
            "min": int(pages.min()),
            "max": int(pages.max()),
        },
        "events": len(sizes),
        "single_events": int((sizes == 1).sum()),
        "double_events": int((sizes == 2).sum()),
        "larger_events": int((sizes > 2).sum()),
        "strokes": sum(fact["strokes"] for fact in facts),
        "force_mean_max_newton": [round(float(norm.mean()), 3), round(float(norm.max()), 3)],
        "noise_share": {name: round(data["info", name].float().mean().item(), 4) for name in (*FAULTS, "is_noise")},
    }
    if "replayed" in facts[0]:
        summary["replayed_pages"] = sum(fact["replayed"] for fact in facts)
        summary["replay_error_metre"] = max(fact["replay_error"] for fact in facts)
    return summary


def show(data: TensorDict, seed: int, folder: Path) -> None:
    """Draws one trajectory, ``[steps]``, as a video and as its force over time."""
    angles = data["info", "edge_angles"].numpy()
    force_over_time(
        data["action"].numpy(),
        folder / "demonstration.png",
        angles=angles,
        flips=count_flips(angles).steps.tolist(),
        faults={name: data["info", name].numpy() for name in FAULTS},
    )
    forces = iter(data["action"].numpy())
    record_rollout(
        lambda _: next(forces),
        folder / "demonstration.gif",
        seconds=len(data) * 0.02,
        seed=seed,
        size=(480, 320),
        env_fn=make_page_flip,
        step_seconds=0.02,
    )


@hydra.main(version_base="1.3", config_path=".", config_name="collect_flip")
def main(cfg: DictConfig) -> None:
    """Records, and says what was recorded."""
    check_options(cfg, {"seed": one_seed, "steps": count})
    keys = ("trajectories", "seed", "steps", "workers", "replay", "progress")
    data, metadata = collect_flips(cfg.output, **{key: cfg[key] for key in keys})
    summary = summarise(data, metadata["trajectories"])
    folder = Path(cfg.output)
    (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    for key, value in summary.items():
        print(f"{key}: {value}")
    if cfg.show is not None:
        part = data[cfg.show * cfg.steps : (cfg.show + 1) * cfg.steps]
        show(part, metadata["trajectories"][cfg.show]["seed"], folder)


if __name__ == "__main__":
    main()
