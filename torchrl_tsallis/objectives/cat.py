"""CAT-soft: a target update that follows the policy robustly, and pulls it back where it refuses to follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_tsallis.optim.segments import Segments
from torchrl_tsallis.optim.student_t import floor_target, robust_rate

__all__ = ["CATSoftUpdate"]

_SCALARS = ("nu", "started")


class CATSoftUpdate(TargetNetUpdater):
    r"""Consolidated adaptive T-soft update of the target parameters.

    Per parameter tensor ``theta`` with target ``thetabar``, scale ``v`` and degrees of freedom ``nu``::

        d2 = (theta - thetabar)^2;  D = mean(d2 / v);  w = (nu + 1) / (nu + D);  w_max = (nu + 1) / nu
        t  = tau w / w_max
        thetabar += t (theta - thetabar);  v += t (d2 + max(eps^2, (d2 - D v) / nu) - v);  nu += t_nu (nu* - nu)
        theta -= strength (tau - t) (theta - thetabar_before)

    ``t_nu`` and ``nu*`` are those of :func:`torchrl_tsallis.optim.student_t.robust_rate` with rate ``tau``. Leading
    dimensions of stacked (ensemble) parameters have scalars of their own, and a member that the loss's
    ``target_members`` leaves out is not pulled. ``k=inf, strength=0`` is torchrl's
    ``SoftUpdate(tau=tau)``. A loss without target parameters is accepted; nothing is updated then. Call
    :meth:`step` after the optimizer's step. A deep copy of the updater no longer follows: make a new one.

    Source: Kobayashi, "Consolidated Adaptive T-soft Update for Deep Reinforcement Learning", arXiv 2202.12504. The
    consolidation is this project's reading: the refused share is applied the other way.

    Args:
        loss_module: the loss whose target parameters are updated.

    Keyword Args:
        tau (float): largest rate of the target, in [0, 1]. Default: 0.1.
        strength (float): strength of the consolidation, in [0, 1]; 0 is AT-soft. Default: 1.0.
        eps (float): square root of the scale's least value. Default: 1e-5.
        k (float): lower bound of the degrees of freedom; ``inf`` switches the robustness off. Default: 1.0.
        init_scale ("first" or "eps"): start the scale at the mean of the tensor's first squared difference that is
            not 0, or at ``eps^2``, where the first steps are all taken for outliers. Default: ``"first"``.

    Raises:
        ValueError: for an argument outside of its range, and for a state dict that does not fit.
        KeyError: for a state dict that lacks an entry.

    Examples:
        >>> from torchrl_tsallis.modules import make_policy
        >>> from torchrl_tsallis.objectives.bc import TsallisBCLoss
        >>> loss = TsallisBCLoss(make_policy(3, 2))
        >>> updater = CATSoftUpdate(loss, tau=0.1)
        >>> updater.step()
    """

    def __init__(
        self,
        loss_module: LossModule,
        *,
        tau: float = 0.1,
        strength: float = 1.0,
        eps: float = 1e-5,
        k: float = 1.0,
        init_scale: Literal["first", "eps"] = "first",
    ) -> None:
        for name, value in (("tau", tau), ("strength", strength)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {value}")
        if not 0 < eps < math.inf:
            raise ValueError(f"eps must be positive and finite, got {eps}")
        if not k > 0:
            raise ValueError(f"k must be positive (inf switches the robustness off), got {k}")
        if init_scale not in ("first", "eps"):
            raise ValueError(f"init_scale must be 'first' or 'eps', got {init_scale!r}")
        self.tau, self.strength, self.eps, self.k, self.init_scale = tau, strength, eps, k, init_scale
        self._cat: dict[str, _Group] = {}
        names = [n for n, _ in loss_module.named_children()] if isinstance(loss_module, LossModule) else [""]
        self._active = any(n == "" or (n.startswith("target_") and n.endswith("_params")) for n in names)
        if self._active:
            super().__init__(loss_module)
        else:
            self.loss_module, self.initialized = loss_module, True
            self._target_names: list[str] = []
            self._source_names: list[str] = []

    def init_(self) -> None:
        """Copies the parameters to the target and starts the state anew."""
        if not self._active:
            return
        super().init_()
        sources = {f"target_{name}": source for name, source in self._sources.items()}
        self._cat = {name: _Group(self, sources[name], target) for name, target in self._targets.items()}

    @torch.no_grad()
    def step(self) -> None:
        """Updates the targets, and the parameters by the consolidation."""
        for group in self._cat.values():
            group.step(self)

    def state_dict(self) -> dict[str, Any]:
        """Copy of the complete state: ``cat/<target group>/<scale|nu|started>/<dotted key>``."""
        return {**super().state_dict(), "cat": {name: group.state_dict() for name, group in self._cat.items()}}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Loads a state in place, after checking all of it."""
        state = state_dict.get("cat", {})
        if set(state) != set(self._cat):
            raise KeyError(f"groups of the state dict are {sorted(state)}, of the loss {sorted(self._cat)}")
        for check_only in (True, False):
            for name, group in self._cat.items():
                group.load(name, state[name], check_only)
        super().load_state_dict(state_dict)


class _Group:
    """State of one group of target parameters: flat ``scale``, stacked ``nu`` and ``started``."""

    def __init__(self, updater: CATSoftUpdate, source: Any, target: Any) -> None:
        self.keys = sorted(target.keys(True, True), key=str)
        self.names = [k if isinstance(k, str) else ".".join(k) for k in self.keys]
        # Both are locked: their tensors stay these. To look them up each step would cost as much as the update.
        self.source, self.target = ([params.get(k) for k in self.keys] for params in (source, target))
        self.segments = Segments(self.target, target.batch_dims)
        flat, eps = self.segments.flatten(self.target), updater.eps
        self.waiting = True  # for the first difference of some tensor
        count, first = self.segments.num_segments, updater.init_scale == "first"
        self.state = {
            "scale": torch.full_like(flat, eps**2),
            "nu": flat.new_full((count,), updater.k + eps),
            "started": flat.new_full((count,), 0.0 if first else 1.0),
        }
        self.alone: Tensor | None = None
        self.buffers: list[tuple[Tensor, list[Tensor]]] = []  # of a step

    def __getstate__(self) -> dict[str, Any]:
        """A pickled view is no view any more: the buffers are made anew."""
        return {**self.__dict__, "buffers": []}

    def _start_scale(self, d2: Tensor, eps: float) -> None:
        """Starts the scale of each tensor at its first squared difference that is not 0."""
        seg, v, started = self.segments, self.state["scale"], self.state["started"]
        first = seg.mean(d2)
        fresh = (started == 0) & (first > 0)
        v.copy_(torch.where(seg.expand(fresh), seg.expand(first.clamp(eps**2, torch.finfo(v.dtype).max / 16)), v))
        started.masked_fill_(fresh, 1.0)
        self.waiting = not bool(started.all())

    def _prepare(self, loss_module: LossModule) -> None:
        """Makes the buffers, and moves the state to the parameters' data type and device."""
        like = self.target[0]
        self.state = {name: x.to(like) for name, x in self.state.items()}
        self.segments = Segments(self.target, self.segments.batch_dims)
        self.buffers = [self.segments.buffer(like) for _ in range(2)]
        pulled = getattr(loss_module, "target_members", None)
        if pulled is not None and self.segments.batch_dims == 1:
            self.alone = self.segments.expand(~pulled.to(like.device).repeat(len(self.target)))

    def step(self, updater: CATSoftUpdate) -> None:
        """One update, in place of the source and the target."""
        source, target, scale = self.source, self.target, self.state["scale"]
        if not self.buffers or scale.dtype != target[0].dtype or scale.device != target[0].device:
            self._prepare(updater.loss_module)
        seg, eps, tau = self.segments, updater.eps, updater.tau
        (d, d_views), (followed, followed_views) = self.buffers
        torch._foreach_copy_(d_views, source)
        torch._foreach_sub_(d_views, target)
        v, nu = self.state["scale"], self.state["nu"]
        d2 = d.square().clamp_(max=torch.finfo(d.dtype).max / 16)
        if self.waiting:
            self._start_scale(d2, eps)
        distance = seg.mean(d2 / v)
        share, new_nu = robust_rate(distance, nu, tau, updater.k, eps)
        floor = floor_target(d2, v, seg.expand(distance), seg.expand(nu.reciprocal()), eps)
        rate = seg.expand(share.mul_(tau))
        v.addcmul_(rate, d2.add_(floor).sub_(v))
        nu.copy_(new_nu)
        torch.mul(rate, d, out=followed)
        torch._foreach_add_(target, followed_views)
        if updater.strength:  # strength (tau - t) d, by what was not followed
            d.mul_(tau).sub_(followed)
            if self.alone is not None:
                d.masked_fill_(self.alone, 0.0)  # a member that is not rated by its target is left alone
            torch._foreach_sub_(source, d_views, alpha=updater.strength)

    def views(self, name: str) -> dict[str, Tensor]:
        """Views of one entry of the state by dotted key."""
        split = self.segments.scalar_views if name in _SCALARS else self.segments.views
        return dict(zip(self.names, split(self.state[name]), strict=True))

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Copies of the state by name and dotted key."""
        return {name: {key: x.clone() for key, x in self.views(name).items()} for name in self.state}

    def load(self, group: str, state: Mapping[str, Mapping[str, Tensor]], check_only: bool) -> None:
        """Checks or copies a state."""
        for name in self.state:
            for key, x in self.views(name).items():
                if key not in state.get(name, {}):
                    raise KeyError(f"the state dict of group {group!r} has no {name!r} of {key!r}")
                value = state[name][key]
                if value.shape != x.shape:
                    raise ValueError(
                        f"{name!r} of {key!r} in group {group!r} has shape {tuple(value.shape)} in the state dict, "
                        f"{tuple(x.shape)} in the loss; load it in a loss of the same architecture"
                    )
                if not check_only:
                    x.copy_(value)
        self.waiting = True
