"""Records the Ant demonstrations: 3 experts x 10 trajectories x 999 pairs, and 3 trajectories of the amateur.

The main job calls this by itself when its cache is empty::

    python recipes/collect_ant.py std=0.2 output=outputs/ant_data
"""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from options import check_options, one_seed, size
from tensordict import TensorDict

from torchrl_tsallis.data import load_demonstrations, load_policy, record_trajectory, save_demonstrations
from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.jobs import run_jobs, tick

EXPERTS = ("expert_0", "expert_1", "expert_2")
TRAJECTORIES = 10


def record(job: tuple[str, int, int], std: float, length: int, clip: bool) -> tuple[TensorDict, int]:
    """Records one trajectory, in a worker process."""
    policy, seed, episode = job
    data, discarded = record_trajectory(make_ant, load_policy(policy), std=std, seed=seed, length=length, clip=clip)
    data["info", "episode"].fill_(episode)
    data["info", "expert"].fill_(episode // TRAJECTORIES)
    tick()
    return data, discarded


def collect_dataset(
    output: str | Path,
    *,
    std: float = 0.2,
    seed: int = 0,
    length: int = 999,
    clip: bool = False,
    experts: tuple[str, ...] = EXPERTS,
    amateur: str = "amateur",
    workers: int = 2,
    progress: bool = True,
) -> tuple[TensorDict, TensorDict]:
    """Loads the demonstrations of the experts and of the amateur, and records them where they are missing.

    Args:
        output: folder of the recordings; the file's name holds the settings and a hash of the policies.
        std: standard deviation of the noise on the executed actions.
        seed: of the recording.
        length: pairs a trajectory.
        clip: whether the noisy commands are clipped to the action space.
        experts: names or files of the experts' policies.
        amateur: name or file of the amateur's policy.
        workers: processes.
        progress: whether to show a bar.

    Returns:
        The experts' demonstrations, ``[len(experts) * 10 * length]``, and the amateur's, ``[len(experts) * length]``.
    """
    digest = hashlib.sha256()
    for name in (*experts, amateur):
        for tensor in load_policy(name).tensors.values():
            digest.update(tensor.tobytes())
    name = f"ant_std{std:g}{'_clipped' if clip else ''}_seed{seed}_length{length}_{digest.hexdigest()[:12]}"
    file = Path(output) / f"{name}.safetensors"
    total = len(experts) * TRAJECTORIES
    if not file.exists():
        jobs = [(experts[i // TRAJECTORIES], 1000 * (seed + 1) + i, i) for i in range(total)]
        jobs += [(amateur, 1000 * (seed + 1) + total + i, total + i) for i in range(len(experts))]
        bar = {"total": len(jobs), "desc": "recording", "unit": "trajectory", "progress": progress}
        results = run_jobs(partial(record, std=std, length=length, clip=clip), jobs, workers=workers, **bar)
        parts, discarded = zip(*results, strict=True)
        facts = {"std": std, "seed": seed, "length": length, "clip": clip, "experts": list(experts), "amateur": amateur}
        returns = [round(float(part["info", "ep_return"][0]), 1) for part in parts]
        save_demonstrations(file, torch.cat(parts), facts | {"discarded": sum(discarded), "returns": returns})
    data, _ = load_demonstrations(file)
    return data[: total * length], data[total * length :]


@hydra.main(version_base="1.3", config_path=".", config_name="collect_ant")
def main(cfg: DictConfig) -> None:
    """Records and says what was recorded."""
    check_options(cfg, {"std": size, "seed": one_seed})
    data = collect_dataset(
        cfg.output, std=cfg.std, seed=cfg.seed, clip=cfg.clip, workers=cfg.workers, progress=cfg.progress
    )
    for name, part in zip(("experts", "amateur"), data, strict=True):
        returns = part["info", "ep_return"].view(-1, 999)[:, 0]
        print(
            f"{name}: {len(part)} pairs, returns {returns.min():.0f} to {returns.max():.0f}, mean {returns.mean():.0f}"
        )


if __name__ == "__main__":
    main()
