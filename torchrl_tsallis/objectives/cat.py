"""CAT-soft: a target update that follows the policy robustly, and pulls it back where it refuses to follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torchrl._utils import logger
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_tsallis._checks import check_choice, check_number, shown
from torchrl_tsallis.objectives.cat_group import CATGroup
from torchrl_tsallis.objectives.replaced import LoadWatch

__all__ = ["CATSoftUpdate"]

#: What float32 still holds, and its square too.
LARGEST = 1e19


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
    :meth:`step` after the optimizer's step. A deep copy of the updater no longer follows: make a new one. A parameter
    under several names is updated once.

    **Policies that are loaded late.** Parameters that are loaded into the actor while its target is another network
    would be pulled to that network and destroyed. Whatever comes through ``load_state_dict`` of the actor, of a part of
    it or of the loss starts the target and its state anew at the loaded parameters, of those members whose parameters
    changed, and the next :meth:`step` says so by a warning. What is written into the parameters in another way is
    noticed in :meth:`step`, by its having nothing in common with what was there: at the first step, and on a CPU at any
    later one. If the loss's state dict brings its target along, both are taken as they come, and a checkpoint continues
    bit for bit; if what was there is loaded back before the next step, so is the target.

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
        TypeError: for an argument of the wrong type, such as None, or a truth value where a number is wanted.
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
        if not isinstance(loss_module, LossModule):
            raise TypeError(f"loss_module must be a loss, as TsallisBCLoss, got {type(loss_module).__name__}")
        tau = check_number("tau", tau, low=0, high=1)
        strength = check_number("strength", strength, low=0, high=1)
        eps = float(check_number("eps", eps, above=0, high=LARGEST))
        k = check_number("k", k, above=0, finite=False)  # inf switches the robustness off
        if LARGEST < k < float("inf"):
            raise ValueError(f"k must be at most {LARGEST:g}, or inf, got {shown(k)}")
        k = float(k)
        check_choice("init_scale", init_scale, ("first", "eps"))
        self.tau, self.strength, self.eps, self.k, self.init_scale = tau, strength, eps, k, init_scale
        self._groups: dict[str, CATGroup] = {}
        self._before: dict[str, dict[str, Any]] | None = None  # what was there before a load, until the next step
        self._loads_target = False
        self._late: dict[str, Tensor] = {}  # members whose parameters were loaded since the last step
        self._detached = False
        names = [name for name, _ in loss_module.named_children()]
        self._active = any(name.startswith("target_") and name.endswith("_params") for name in names)
        if self._active:
            super().__init__(loss_module)
        else:
            self.loss_module, self.initialized = loss_module, True
            self._target_names: list[str] = []
            self._source_names: list[str] = []

    @torch.no_grad()
    def init_(self) -> None:
        """Copies the parameters to the target and starts the state anew."""
        if not self._active:
            return
        super().init_()
        self._groups = {
            f"target_{name}": CATGroup(
                trained,
                self._targets[f"target_{name}"],
                (getattr(self.loss_module, name), getattr(self.loss_module, f"target_{name}")),
                eps=self.eps,
                k=self.k,
                from_first=self.init_scale == "first",
            )
            for name, trained in self._sources.items()
        }
        for group in self._groups.values():  # what is not trained too
            group.restart(torch.ones(group.batch_shape, dtype=torch.bool, device=group.target[0].device))
        self._forget()
        self._watch_loads()

    def _watch_loads(self) -> None:
        found = [getattr(self.loss_module, name.removesuffix("_params"), None) for name in self._source_names]
        networks = [network for network in found if isinstance(network, nn.Module)]
        self._tied = [network for network in networks if self._owns(network)]  # not the first of stacked members
        self._watch = LoadWatch([self.loss_module, *networks], self._before_load, self._after_load)

    def _owns(self, network: nn.Module) -> bool:
        """Whether a network's parameters are those that the loss trains."""
        own = {id(source) for group in self._groups.values() for source, _ in group.everything}
        return all(id(p) in own for p in network.parameters())

    def __getstate__(self) -> dict[str, Any]:
        """A file or a copy takes no hooks along."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_watch", "_tied")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Watches the loss that came along."""
        self.__dict__.update(state)
        if self._active:
            self._watch_loads()

    def _forget(self) -> None:
        self._before, self._late, self._detached = None, {}, False

    @torch.no_grad()
    def _before_load(self, state_dict: Mapping[str, Any], prefix: str) -> None:
        """Keeps what is there: the load may bring it back, or only change a part."""
        self._loads_target = any(key.startswith(tuple(f"{prefix}{n}." for n in self._groups)) for key in state_dict)
        if self._before is None:
            self._before = {name: group.snapshot() for name, group in self._groups.items()}

    @torch.no_grad()
    def _after_load(self, module: nn.Module) -> None:
        """Starts the targets of loaded parameters anew at them."""
        for name, group in self._groups.items():
            before = (self._before or {})[name]
            if self._loads_target:  # as in a checkpoint: both are as they should be
                group.restore(before, target=False)
                continue
            group.restore(before)
            changed = group.changed(before)
            if changed.any():
                group.restart(changed)
                self._late[name] = changed
            else:
                self._late.pop(name, None)
        if self._loads_target:
            self._forget()
        elif any(module is part for network in self._tied for part in network.modules()):
            self._detached |= not self._owns(module)

    @torch.no_grad()
    def step(self) -> None:
        """Updates the targets, and the parameters by the consolidation."""
        members = getattr(self.loss_module, "target_members", None)
        for name, group in self._groups.items():
            replaced = group.step(self.tau, self.strength, members)
            if replaced is not None:
                self._late[name] = replaced | self._late.get(name, replaced)
        if self._before is not None or self._late:
            self._warn()
            self._forget()

    def _warn(self) -> None:
        for name, changed in self._late.items():
            some = f" of members {changed.nonzero()[:, 0].tolist()}" if changed.ndim else ""
            logger.warning(
                f"other parameters{some} were loaded into {name.removeprefix('target_')} after its target network was "
                "made: the target starts anew at them. Load a policy before CATSoftUpdate is made, or a checkpoint by "
                "loss.load_state_dict, which restores the target too"
            )
        if self._detached:
            logger.warning(
                "load_state_dict(assign=True) gave the actor other parameters than those that the loss trains: load "
                "without assign, or before the loss is made"
            )

    def state_dict(self) -> dict[str, Any]:
        """Copy of the complete state: ``cat/<target group>/<scale|nu|started>/<dotted key>``."""
        return {**super().state_dict(), "cat": {name: group.state_dict() for name, group in self._groups.items()}}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Loads a state in place, after checking all of it."""
        state = state_dict.get("cat", {})
        if set(state) != set(self._groups):
            raise KeyError(f"groups of the state dict are {sorted(state)}, of the loss {sorted(self._groups)}")
        for check_only in (True, False):
            for name, group in self._groups.items():
                group.load(name, state[name], check_only)
        if self._before is not None:  # whatever the order in which actor, loss and updater are loaded
            for name, group in self._groups.items():
                self._before[name] |= {"state": {n: x.clone() for n, x in group.state.items()}, "waiting": True}
        super().load_state_dict(state_dict)
