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
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import hydra
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401
import torch
from omegaconf import DictConfig
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torch.nn import functional as F
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators
from tqdm import tqdm

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
KEYS = ["observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")]


class _Gaussian(nn.Module):
    """Split the network's output into a mean and a standard deviation."""

    def forward(self, out: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, log_std = out.chunk(2, -1)
        return loc, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX).exp()


def make_loss(cfg: DictConfig, obs_dim: int, act_dim: int) -> tuple[SACLoss, MLP]:
    """Build TorchRL's SAC loss; also return the actor's network."""
    net = MLP(obs_dim, 2 * act_dim, num_cells=list(cfg.actor_cells), activation_class=nn.ReLU)
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(nn.Sequential(net, _Gaussian()), ["observation"], ["loc", "scale"]),
        ProbabilisticTensorDictModule(
            ["loc", "scale"], ["action"], distribution_class=TanhNormal, return_log_prob=True
        ),
    )
    critic = MLP(obs_dim + act_dim, 1, num_cells=list(cfg.critic_cells), activation_class=nn.ReLU)
    critic = ValueOperator(critic, in_keys=["action", "observation"])
    loss = SACLoss(actor, critic, num_qvalue_nets=2, loss_function="l2", target_entropy=float(cfg.target_entropy))
    loss.make_value_estimator(ValueEstimators.TD0, gamma=float(cfg.gamma))
    return loss, net


def written_out(loss: SACLoss, gamma: float, target_entropy: float) -> Callable[..., torch.Tensor]:
    """Return the sum of SACLoss's terms, as a function of a batch's ``KEYS``.

    The arithmetic and the parameters are SACLoss's, without the dispatch of
    vmap and TensorDict: one update takes less than half the time on a CPU
    (``torch.compile`` gains less than that).
    """
    layers = [(f"{i}", kind) for i in (0, 2, 4) for kind in ("weight", "bias")]
    critics = [loss.qvalue_network_params.get(("module", *k)) for k in layers]
    targets = [loss.target_qvalue_network_params.get(("module", *k)) for k in layers]
    actor = [loss.actor_network_params.get(("module", "0", "module", "0", *k)) for k in layers]
    log_alpha = loss.log_alpha

    def mlp(x: torch.Tensor, w: Any) -> torch.Tensor:
        return F.linear(F.linear(F.linear(x, w[0], w[1]).relu(), w[2], w[3]).relu(), w[4], w[5])

    def value(w: list[torch.Tensor], obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        x = torch.cat([action, obs], -1)
        return torch.stack([mlp(x, each)[:, 0] for each in zip(*(p.unbind(0) for p in w), strict=True)])

    def sample(obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc, log_std = mlp(obs, actor).chunk(2, -1)
        log_std = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        noise = torch.randn_like(loc)
        raw = loc + log_std.exp() * noise
        log_prob = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))
        return raw.tanh(), log_prob.sum(-1)

    def losses(obs: torch.Tensor, action: torch.Tensor, next_obs: torch.Tensor, *outcome: torch.Tensor) -> torch.Tensor:
        reward, terminated = (x[:, 0].float() for x in outcome)
        alpha = log_alpha.detach().exp()
        with torch.no_grad():
            next_action, next_log_prob = sample(next_obs)
            next_value = value(targets, next_obs, next_action).amin(0) - alpha * next_log_prob
            target = reward + gamma * (1.0 - terminated) * next_value
        loss_qvalue = (value(critics, obs, action) - target).square().sum(0).mean()
        new_action, log_prob = sample(obs)
        new_value = value([w.detach() for w in critics], obs, new_action).amin(0)
        loss_alpha = -(log_alpha * (log_prob.detach() + target_entropy)).mean()
        return loss_qvalue + (alpha * log_prob - new_value).mean() + loss_alpha

    return losses


def export_policy(net: MLP) -> dict[str, torch.Tensor]:
    """Return the actor as plain tensors: ``x @ w1 + b1``, ReLU, and so on."""
    tensors = {}
    for i, layer in enumerate((m for m in net.modules() if isinstance(m, nn.Linear)), start=1):
        tensors[f"w{i}"] = layer.weight.detach().t().contiguous().clone()
        tensors[f"b{i}"] = layer.bias.detach().clone()
    return tensors


def numpy_policy(tensors: dict[str, torch.Tensor]) -> Callable[..., np.ndarray]:
    """Return the exported policy in NumPy, several times faster for one observation."""
    w1, b1, w2, b2, w3, b3 = (tensors[k].numpy() for k in ("w1", "b1", "w2", "b2", "w3", "b3"))

    def policy(obs: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        out = np.maximum(np.maximum(obs @ w1 + b1, 0.0) @ w2 + b2, 0.0) @ w3 + b3
        loc, log_std = np.split(out, 2)
        if rng is not None:  # a sample, else the mode
            std = np.exp(np.clip(log_std, LOG_STD_MIN, LOG_STD_MAX))
            loc = loc + std * rng.standard_normal(loc.shape, dtype=np.float32)
        return np.tanh(loc)

    return policy


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


def save_atomically(path: Path, write: Callable[[str], None]) -> None:
    """Write through a temporary file so that a reader never sees half a file."""
    temporary = path.with_name(path.name + ".tmp")
    write(str(temporary))
    os.replace(temporary, path)


def train(cfg: DictConfig) -> None:
    """Train one agent."""
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
            save_atomically(out / f"policy_{mark}.safetensors", lambda p, t=tensors, m=meta: save_file(t, p, m))
            state = {"loss": dict(loss.state_dict()), "optimizer": optimizer.state_dict(), "step": step}
            state |= {"rng": torch.get_rng_state(), "numpy_rng": json.dumps(rng.bit_generator.state)}
            save_atomically(out / "checkpoint.pt", lambda p, s=state: torch.save(s, p))
            if cfg.save_buffer:
                content = buffer[:].select(*KEYS).to_dict()
                save_atomically(out / "buffer.pt", lambda p, c=content: torch.save(c, p))
            progress.set_postfix(ret=f"{score:.0f}", len=f"{length:.0f}", refresh=False)
    progress.close()


def write_card(cfg: DictConfig) -> None:
    """Evaluate the policies to ship, copy them and write their model card."""
    env = gym.make(cfg.env_id, disable_env_checker=True)
    folder, rows = Path(cfg.card.policies_dir), []
    folder.mkdir(parents=True, exist_ok=True)
    Path(cfg.card.path).parent.mkdir(parents=True, exist_ok=True)
    for name, source in tqdm(cfg.card.policies.items(), disable=not cfg.progress):
        with safe_open(source, "pt") as file:
            tensors, meta = {k: file.get_tensor(k) for k in file.keys()}, dict(file.metadata())  # noqa: SIM118
        save_file(tensors, str(folder / f"{name}.safetensors"), meta)
        os.chmod(folder / f"{name}.safetensors", 0o644)
        cells = [f"`{name}`", meta["seed"], f"{int(meta['steps']):,}"]
        for rng in (None, np.random.default_rng(0)):
            returns, lengths = evaluate(env, numpy_policy(tensors), cfg.card.episodes, rng)
            cells.append(f"{returns.mean():.0f} ± {returns.std():.0f} [{returns.min():.0f}, {returns.max():.0f}]")
            cells.append(f"{lengths.mean():.0f}")
        rows.append("| " + " | ".join(cells) + " |")
    text = CARD.format(rows="\n".join(rows), episodes=cfg.card.episodes, env_id=cfg.env_id)
    save_atomically(Path(cfg.card.path), lambda p: Path(p).write_text(text, encoding="utf-8"))


CARD = """# Model card: the policies that record the Ant datasets

Soft actor-critic agents for `{env_id}`, trained by `recipes/train_experts.py`; the hyper-parameters are in
`recipes/train_experts.yaml`. Each is a 28-128-128-16 ReLU network, kept as safetensors (`w1`, `b1`, `w2`, `b2`, `w3`,
`b3`, float32) with its origin as metadata: `action = tanh(out[:8])`, and `out[8:]` is the logarithm of the standard
deviation before it is clamped to [-20, 2]. The observations are not normalised.

Undiscounted returns of {episodes} episodes of at most 1000 steps, reset with the seeds 10000 and up: mean ± standard
deviation [lowest, highest], and the mean length. *Stochastic* samples the action, *deterministic* takes its mode.

| policy | seed | steps | deterministic | length | stochastic | length |
|---|---|---|---|---|---|---|
{rows}

The amateur is an early snapshot of a run: it keeps standing and moves slowly. The policies are meant for recording
demonstrations in simulation and comparing imitation learners; they are not fit to drive a real robot.
"""


@hydra.main(version_base="1.3", config_path=".", config_name="train_experts")
def main(cfg: DictConfig) -> None:
    """Run the configured mode."""
    {"train": train, "card": write_card}[cfg.mode](cfg)


if __name__ == "__main__":
    main()
