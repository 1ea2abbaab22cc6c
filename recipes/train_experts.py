"""Train the SAC agents whose policies record the Ant datasets.

Usage::

    python recipes/train_experts.py seed=0 steps=450000 out=outputs/experts/seed_0
    python recipes/train_experts.py mode=card out=outputs/card

Every ``eval_every`` steps a row is appended to ``log.csv``, and the policy
(``policy_<step>.safetensors``) and a resumable ``checkpoint.pt`` are saved.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium as gym
import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from options import (
    by_name,
    check_flag,
    check_number,
    check_options,
    check_path,
    check_text,
    choice,
    count,
    listed,
    one_seed,
    positive,
    share,
    size,
    whole,
)
from sac import export_policy, make_loss, numpy_policy, written_out
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from torchrl_tsallis.envs import register_ant
from torchrl_tsallis.jobs import atomic_path, run_jobs, tick

KEYS = ["observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")]


#: What the options may be that other recipes do not have, or have of another kind.
OWN = {
    "mode": choice("train", "card"), "env_id": check_text, "seed": one_seed, "steps": count, "out": check_path,
    "save_buffer": check_flag, "actor_cells": listed(count), "critic_cells": listed(count),
    "env_steps_per_update": count, "frames_per_batch": count, "gamma": share, "tau": share, "lr": positive,
    "lr_final": size, "target_entropy": partial(check_number, low=-1e9, high=1e9), "buffer_size": count,
    "random_steps": whole, "eval_every": count, "eval_episodes": count, "card.episodes": count,
    "card.path": check_path, "card.policies_dir": check_path, "card.history": check_text,
    "card.policies": by_name(check_path),
}  # fmt: skip


def evaluate(env: gym.Env, policy: Callable, episodes: int, rng: np.random.Generator | None = None) -> np.ndarray:
    """Run full episodes; return their returns and lengths, shaped [2, episodes]."""
    results = np.zeros((2, episodes))
    for episode in range(episodes):
        obs, over = env.reset(seed=10_000 + episode)[0], False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(policy(obs, rng))
            results[:, episode] += float(reward), 1
            over = terminated or truncated
    return results


def train(cfg: DictConfig) -> None:
    """Train one agent."""
    register_ant()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(cfg.seed)
    rng = np.random.default_rng(cfg.seed)
    out = Path(cfg.out)
    out.mkdir(parents=True, exist_ok=True)
    env, eval_env = (gym.make(cfg.env_id, disable_env_checker=True) for _ in range(2))
    act_dim = env.action_space.shape[0]
    loss, net = make_loss(cfg, env.observation_space.shape[0], act_dim)
    losses = written_out(loss, float(cfg.gamma), float(cfg.target_entropy))
    updater = SoftUpdate(loss, tau=float(cfg.tau))
    # Each term of the loss reaches the weights of its own network only, so one
    # optimizer over the sum of the terms is the same as three.
    optimizer = torch.optim.Adam(loss.parameters(), lr=torch.tensor(float(cfg.lr)), fused=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(cfg.buffer_size))
    step = start = 0
    if cfg.resume and (out / "checkpoint.pt").exists():
        state = torch.load(out / "checkpoint.pt", weights_only=True)
        loss.load_state_dict(state["loss"])
        optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["rng"])
        rng.bit_generator.state = json.loads(state["numpy_rng"])
        step = start = state["step"]
        if (out / "buffer.pt").exists():
            buffer.extend(TensorDict(torch.load(out / "buffer.pt", weights_only=True)).auto_batch_size_(1))
    warmup = start + (0 if len(buffer) else cfg.random_steps)
    progress = tqdm(total=cfg.steps, initial=step, disable=not cfg.progress, mininterval=5)
    policy = numpy_policy(export_policy(net))
    obs, _ = env.reset(seed=int(cfg.seed) + start)
    # A hand loop collects: TorchRL's collector steps this environment at about
    # half the rate of the raw one.
    while step < cfg.steps:
        count, rows = min(cfg.frames_per_batch, cfg.steps - step), []
        for _ in range(count):
            explore = step < cfg.random_steps
            action = rng.uniform(-1.0, 1.0, act_dim).astype(np.float32) if explore else policy(obs, rng)
            next_obs, reward, terminated, truncated, _ = env.step(action)
            rows.append((obs, action, next_obs, [np.float32(reward)], [terminated]))
            obs = env.reset()[0] if terminated or truncated else next_obs
            step += 1
        data = TensorDict({}, [count])
        data.update({k: torch.as_tensor(np.asarray(v)) for k, v in zip(KEYS, zip(*rows, strict=True), strict=True)})
        buffer.extend(data)
        if step >= warmup:
            optimizer.param_groups[0]["lr"].fill_(cfg.lr + (cfg.lr_final - cfg.lr) * step / cfg.steps)
            sample = buffer.sample(max(1, count // cfg.env_steps_per_update) * cfg.batch_size)
            for batch in zip(*(sample.get(k).split(cfg.batch_size) for k in KEYS), strict=True):
                losses(*batch).backward()
                optimizer.step()
                optimizer.zero_grad(set_to_none=False)
                updater.step()
            policy = numpy_policy(export_policy(net))
        progress.update(count)
        if step // cfg.eval_every > (step - count) // cfg.eval_every or step >= cfg.steps:
            mark = step if step >= cfg.steps else step // cfg.eval_every * cfg.eval_every
            score, length = evaluate(eval_env, policy, cfg.eval_episodes).mean(1)
            new = not (out / "log.csv").exists()
            with open(out / "log.csv", "a", newline="") as file:
                rows = [["step", "return", "length"]] * new + [[mark, f"{score:.2f}", f"{length:.1f}"]]
                csv.writer(file).writerows(rows)
            meta = {"algorithm": "SAC", "seed": str(cfg.seed), "steps": str(mark), "env_id": cfg.env_id}
            tensors = export_policy(net)
            with atomic_path(out / f"policy_{mark}.safetensors") as path:
                save_file(tensors, path, meta)
            state = {"loss": dict(loss.state_dict()), "optimizer": optimizer.state_dict(), "step": step}
            state |= {"rng": torch.get_rng_state(), "numpy_rng": json.dumps(rng.bit_generator.state)}
            with atomic_path(out / "checkpoint.pt") as path:
                torch.save(state, path)
            if cfg.save_buffer:
                content = buffer[:].select(*KEYS).to_dict()
                with atomic_path(out / "buffer.pt") as path:
                    torch.save(content, path)
            progress.set_postfix(ret=f"{score:.0f}", len=f"{length:.0f}", refresh=False)
    progress.close()


def card_row(policy: tuple[str, str], cfg: DictConfig) -> str:
    """Copy a policy to where it is shipped, evaluate it, and describe it in a row of the card's table."""
    name, source = policy
    register_ant()
    env = gym.make(cfg.env_id, disable_env_checker=True)
    env.reset(seed=0)  # the first episode of a fresh PyBullet environment starts unlike all later ones
    with safe_open(source, "pt") as file:
        tensors, meta = {k: file.get_tensor(k) for k in file.keys()}, dict(file.metadata())  # noqa: SIM118
    with atomic_path(Path(cfg.card.policies_dir) / f"{name}.safetensors") as path:
        save_file(tensors, path, meta)
    cells = [f"`{name}`", meta["seed"], f"{int(meta['steps']):,}"]
    for rng in (None, np.random.default_rng(0)):
        returns, lengths = evaluate(env, numpy_policy(tensors), cfg.card.episodes, rng)
        cells.append(f"{returns.mean():.0f} ± {returns.std():.0f} [{returns.min():.0f}, {returns.max():.0f}]")
        cells.append(f"{lengths.mean():.0f}")
    tick()
    return "| " + " | ".join(cells) + " |"


def write_card(cfg: DictConfig) -> None:
    """Write the model card of the policies to ship."""
    policies = list(cfg.card.policies.items())
    bar = {"total": len(policies), "desc": "evaluating", "unit": "policy"}
    rows = run_jobs(partial(card_row, cfg=cfg), policies, workers=2, **bar)
    text = CARD.format(rows="\n".join(rows), cfg=cfg)
    with atomic_path(cfg.card.path) as path:
        path.write_text(text, encoding="utf-8")


CARD = """# Model card: the policies that record the Ant datasets

Soft actor-critic agents for `{cfg.env_id}`, trained by `recipes/train_experts.py`; the hyper-parameters are in
`recipes/train_experts.yaml`. Each is a 28-128-128-16 ReLU network, kept as safetensors (`w1`, `b1`, `w2`, `b2`, `w3`,
`b3`, float32) with its origin as metadata: `action = tanh(out[:8])`, and `out[8:]` is the logarithm of the standard
deviation before it is clamped to [-20, 2]. The observations are not normalised.

Undiscounted returns of {cfg.card.episodes} episodes of at most 1000 steps, reset with the seeds 10000 and up: mean ±
standard deviation [lowest, highest], and the mean length. *Stochastic* samples the action, *deterministic* takes its
mode.

| policy | seed | steps | deterministic | length | stochastic | length |
|---|---|---|---|---|---|---|
{rows}

{cfg.card.history}

The amateur keeps standing and moves slowly. The policies are meant for recording
demonstrations in simulation and comparing imitation learners; they are not fit to drive a real robot.
"""


@hydra.main(version_base="1.3", config_path=".", config_name="train_experts")
def main(cfg: DictConfig) -> None:
    """Run the configured mode."""
    check_options(cfg, OWN)
    {"train": train, "card": write_card}[cfg.mode](cfg)


if __name__ == "__main__":
    main()
