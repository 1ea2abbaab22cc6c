"""Soft actor-critic for recipes/train_experts.py: TorchRL's loss, the same written out for speed, and its policy."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torch.nn import functional as F
from torchrl.modules import MLP, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, ValueEstimators

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


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
    """Return the sum of SACLoss's terms, as a function of a batch.

    Its arguments are the observation, action, next observation, reward and termination.

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
