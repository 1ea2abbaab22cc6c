"""Consolidated adaptive T-soft update of target networks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_tsallis._student_t import degrees_of_freedom_step, robust_share, spread, tensor_means


class CATSoftUpdate(TargetNetUpdater):
    r"""Robust soft update: a target network that follows usual changes of the policy, and outlying ones less.

    For each parameter tensor, with :math:`d = \theta - \bar\theta` and :math:`D = \mathrm{mean}(d^2 / v)`:

    .. math::
        t &= \tau \frac{\nu}{\nu + D}, \quad
        \bar\theta \leftarrow \bar\theta + t d, \quad
        v \leftarrow v + t \left(d^2 + \max\left(\epsilon^2, \frac{d^2 - D v}{\nu}\right) - v\right), \\
        \theta &\leftarrow \theta - \mathrm{strength} \, (\tau - t) \, d

    The degrees of freedom :math:`\nu` follow the data as in AdaTerm. The last line, the consolidation, brings the
    policy back towards the target where the target refused to follow.
    :class:`torchrl.objectives.SoftUpdate` is the limit of ``nu=inf, strength=0``.

    ==================  ===========  ==========  =========================================
    symbol              argument     default     source
    ==================  ===========  ==========  =========================================
    tau                 tau          0.1         this project
    consolidation       strength     1.0         this project's reading of arXiv 2202.12504
    epsilon             eps          1e-5        AdaTerm's
    k                   k            1.0         AdaTerm's
    start of nu         nu           k + eps     AdaTerm's
    start of v          init_scale   "first"     this project
    ==================  ===========  ==========  =========================================

    Source: Kobayashi, "Consolidated adaptive T-soft update", arXiv 2202.12504, as read by this project.

    Args:
        loss_module: a loss with target parameters. For a loss without them every step does nothing.

    Keyword Args:
        tau (float): largest rate in (0, 1]. Default: 0.1.
        strength (float): consolidation in [0, 1]; 0 leaves the policy alone. Default: 1.0.
        eps (float): square root of the scale's floor. Default: 1e-5.
        k (float): lower bound of the degrees of freedom. Default: 1.0.
        nu (float): first degrees of freedom, ``inf`` for a plain soft update. Default: ``k + eps``.
        init_scale ("first" or "eps"): start of v. From ``eps**2`` every step is an outlier until v has grown, some
            hundred steps; ``"first"`` starts at the first :math:`d^2`. Default: ``"first"``.

    Raises:
        ValueError: if an argument is outside of its range, or a state of another network is loaded.

    Examples:
        >>> from torchrl_tsallis import TsallisBCLoss
        >>> from torchrl_tsallis.modules import make_policy
        >>> loss = TsallisBCLoss(make_policy(3, 2))
        >>> CATSoftUpdate(loss, tau=0.01).step()
    """

    def __init__(
        self,
        loss_module: LossModule,
        *,
        tau: float = 0.1,
        strength: float = 1.0,
        eps: float = 1e-5,
        k: float = 1.0,
        nu: float | None = None,
        init_scale: Literal["first", "eps"] = "first",
    ) -> None:
        if not 0 < tau <= 1:
            raise ValueError(f"tau must be in (0, 1], got {tau}")
        if not 0 <= strength <= 1:
            raise ValueError(f"strength must be in [0, 1], got {strength}")
        if eps <= 0 or k <= 0:
            raise ValueError(f"eps and k must be positive, got {eps=} and {k=}")
        if nu is not None and nu <= k:
            raise ValueError(f"nu must be larger than k = {k}, got {nu}")
        if init_scale not in ("first", "eps"):
            raise ValueError(f"init_scale must be 'first' or 'eps', got {init_scale!r}")
        self.tau, self.strength, self.eps, self.k = tau, strength, eps, k
        self.first_nu = k + eps if nu is None else nu
        self.init_scale = init_scale
        self._state: dict[str, dict[str, Any]] = {}
        self.enabled = any(name.startswith("target_") for name, _ in loss_module.named_children())
        if self.enabled:
            super().__init__(loss_module)

    def init_(self) -> None:
        """Copies the policy into the target and starts the state anew; part of the construction."""
        if not self.enabled:
            return
        super().init_()
        self._state = {}
        for name, target in self._targets.items():
            keys = sorted(target.keys(True, True), key=str)
            tensors = [target.get(key) for key in keys]
            members = target.batch_size
            self._state[name] = {
                "keys": keys,
                "v": [torch.full_like(x, self.eps**2) for x in tensors],
                "nu": tensors[0].new_full((len(keys), *members), self.first_nu),
                "started": torch.zeros((), dtype=torch.bool),
            }

    @torch.no_grad()
    def step(self) -> None:
        """Moves every target network, and the policy where consolidation asks for it."""
        for name in self._state:
            source = self._sources[name.removeprefix("target_")]
            self._step_group(source, self._targets[name], self._state[name])

    def _step_group(self, source: Any, target: Any, state: dict[str, Any]) -> None:
        nb = target.batch_dims
        new = [source.get(key).data for key in state["keys"]]
        old = [target.get(key).data for key in state["keys"]]
        deviation = torch._foreach_sub(new, old)
        if not math.isfinite(self.first_nu):
            torch._foreach_add_(old, deviation, alpha=self.tau)
            return
        # Follow the loss to another device or dtype.
        state["v"] = v = [x.to(like) for x, like in zip(state["v"], old, strict=True)]
        state["nu"] = nu = state["nu"].to(old[0])
        square = torch._foreach_mul(deviation, deviation)
        if self.init_scale == "first" and not state["started"]:
            self._start(v, square, nb)
            state["started"].fill_(bool(any(x.any() for x in square)))
        distance = tensor_means(torch._foreach_div(square, v), nb)
        share = robust_share(distance, nu)
        state["nu"] = degrees_of_freedom_step(distance, nu, self.tau, self.k, self.eps)
        rate = self.tau * share
        by_rate = spread(rate, old, nb)

        floor = torch._foreach_mul(v, spread(-distance, old, nb))
        torch._foreach_add_(floor, square)
        torch._foreach_div_(floor, spread(nu, old, nb))
        torch._foreach_clamp_min_(floor, self.eps**2)
        torch._foreach_add_(floor, square)
        torch._foreach_sub_(floor, v)
        torch._foreach_mul_(floor, by_rate)
        torch._foreach_add_(v, floor)
        torch._foreach_add_(old, torch._foreach_mul(deviation, by_rate))
        if self.strength:
            torch._foreach_mul_(deviation, spread((rate - self.tau) * self.strength, old, nb))
            torch._foreach_add_(new, deviation)

    def _start(self, v: list[Tensor], square: Sequence[Tensor], nb: int) -> None:
        """Starts each scale at its tensor's mean squared deviation: single entries may not have moved yet."""
        for scale, mean in zip(v, spread(tensor_means(square, nb), v, nb), strict=True):
            scale.copy_(mean.clamp_min(self.eps**2).expand_as(scale))

    def state_dict(self) -> dict[str, Any]:
        """Scale, degrees of freedom and start flag of every parameter, under ``cat``."""
        groups = {
            name: {
                "v": {_dotted(key): x.clone() for key, x in zip(state["keys"], state["v"], strict=True)},
                "nu": state["nu"].clone(),
                "started": state["started"].clone(),
            }
            for name, state in self._state.items()
        }
        return {**(super().state_dict() if self.enabled else {}), "cat": groups}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave.

        Raises:
            ValueError: if the state is of another network; the message names the parameter and both shapes.
        """
        state_dict = dict(state_dict)
        groups = state_dict.pop("cat")
        if self.enabled:
            super().load_state_dict(state_dict)
        if set(groups) != set(self._state):
            raise ValueError(
                f"the state is of {sorted(groups)}, this updater of {sorted(self._state)}: load it into "
                "an updater of the same loss"
            )
        for name, state in self._state.items():
            saved = groups[name]
            for key, own in zip(state["keys"], state["v"], strict=True):
                found = saved["v"].get(_dotted(key))
                if found is None or found.shape != own.shape:
                    raise ValueError(
                        f"{name}.{_dotted(key)} has shape {list(own.shape)}, in the state "
                        f"{None if found is None else list(found.shape)}: build the checkpoint's network"
                    )
                own.copy_(found)
            state["nu"] = saved["nu"].clone().to(state["nu"])
            state["started"] = saved["started"].clone()


def _dotted(key: Any) -> str:
    key = unravel_key(key)
    return key if isinstance(key, str) else ".".join(key)
