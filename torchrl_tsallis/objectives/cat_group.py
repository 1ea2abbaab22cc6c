"""One group of parameters and their target: the state of CAT-soft in flat vectors, and its update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis import native
from torchrl_tsallis.native import updates
from torchrl_tsallis.objectives.replaced import replaced_members
from torchrl_tsallis.optim.segments import Segments
from torchrl_tsallis.optim.student_t import floor_target, robust_rate

_SCALARS = ("nu", "started")
_FAR = 1e4  # normalised squared distance beyond which the parameters may be others


def _rows(mask: Tensor, like: Tensor) -> Tensor:
    """A mask of members ``[*B]`` that broadcasts over ``[*B, *E]``."""
    return mask.view(mask.shape + (1,) * (like.ndim - mask.ndim))


class CATGroup:
    """Flat ``scale``, stacked ``nu`` and ``started`` of the trained parameters, each tensor once.

    A tensor under several names, as an encoder that two inputs share, is updated under the first; the targets of the
    other names are copies of the first's. What is not trained, and buffers, belong to ``everything`` alone: they are
    only copied where the target starts anew.

    Args:
        trained: the parameters by key, ``[*B]``.
        targets: their targets, of the same keys.
        everything: parameters and targets as the loss holds them, with those that are not trained.
        eps: square root of the scale's least value.
        k: lower bound of the degrees of freedom.
        from_first: whether the scale starts at the first difference.
    """

    def __init__(
        self,
        trained: TensorDictBase,
        targets: TensorDictBase,
        everything: tuple[TensorDictBase, TensorDictBase],
        *,
        eps: float,
        k: float,
        from_first: bool,
    ) -> None:
        self.eps, self.k, self.from_first = eps, k, from_first
        # All are locked: their tensors stay these. To look them up each step would cost as much as the update.
        self.source: list[Tensor] = []
        self.target: list[Tensor] = []
        self.names: list[str] = []
        self.copies: list[tuple[Tensor, Tensor]] = []  # of a target, for other names of the same parameter
        seen: dict[int, int] = {}
        for key in sorted(trained.keys(True, True), key=str):
            source, target = trained.get(key), targets.get(key)
            if id(source) in seen:
                self.copies.append((target, self.target[seen[id(source)]]))
                continue
            seen[id(source)] = len(self.source)
            self.source.append(source)
            self.target.append(target)
            self.names.append(key if isinstance(key, str) else ".".join(key))
        sources, follow = everything
        keys = [key for key in sources.keys(True, True) if key in follow.keys(True, True)]
        self.everything = [(sources.get(key), follow.get(key)) for key in keys]
        self.batch_shape = targets.batch_size
        self.segments = Segments(self.target, targets.batch_dims)
        self.state = self._started(self.target[0])
        self.waiting = True  # for the first difference of some tensor
        self.spread: Tensor | None = None  # variance of each tensor of the target, once it was asked for
        self.alone: Tensor | None = None
        self.members: Tensor | None = None  # those that are not pulled
        self.buffers: list[tuple[Tensor, list[Tensor]]] = []  # of a step
        self.layout: updates.Layout | None = None

    def __getstate__(self) -> dict[str, Any]:
        """A pickled view is no view any more: the buffers are made anew."""
        return {**self.__dict__, "buffers": [], "layout": None}

    def _started(self, like: Tensor) -> dict[str, Tensor]:
        """The state at the start."""
        count = self.segments.num_segments
        return {
            "scale": like.new_full((len(self.segments.ids),), self.eps**2),
            "nu": like.new_full((count,), self.k + self.eps),
            "started": like.new_full((count,), 0.0 if self.from_first else 1.0),
        }

    def _start_scale(self, d2: Tensor) -> bool:
        """Starts the scale of each tensor at its first squared difference that is not 0; whether there was one."""
        seg, v, started = self.segments, self.state["scale"], self.state["started"]
        first = seg.mean(d2)
        fresh = (started == 0) & (first > 0)
        largest = torch.finfo(v.dtype).max / 16
        v.copy_(torch.where(seg.expand(fresh), seg.expand(first.clamp(self.eps**2, largest)), v))
        started.masked_fill_(fresh, 1.0)
        self.waiting = not bool(started.all())
        return bool(fresh.any())

    def _follow_type(self, members: Tensor | None) -> None:
        """Makes the buffers, and moves the state to the parameters' data type and device."""
        like = self.target[0]
        self.state = {name: x.to(like) for name, x in self.state.items()}
        self.segments = Segments(self.target, self.segments.batch_dims)
        self.buffers = [self.segments.buffer(like) for _ in range(2)]
        self.spread = None
        if members is not None and self.segments.batch_dims == 1:
            self.members = ~members.to(like.device)
            self.alone = self.segments.expand(self.members.repeat(len(self.target)))

    def _difference(self) -> Tensor:
        d, views = self.buffers[0]
        torch._foreach_copy_(views, self.source)
        torch._foreach_sub_(views, self.target)
        return d

    def step(self, tau: float, strength: float, members: Tensor | None = None) -> Tensor | None:
        """One update, in place of the parameters and their target.

        Args:
            tau: largest rate.
            strength: of the consolidation.
            members: which of the members are pulled, ``[S]`` bool. Default: None, all.

        Returns:
            Members ``[*B]`` whose parameters were replaced since the last step, so that their target was started anew
            at them; None if there are none.
        """
        scale = self.state["scale"]
        if not self.buffers or scale.dtype != self.target[0].dtype or scale.device != self.target[0].device:
            self._follow_type(members)
        if self._native_step(tau, strength):
            return None
        seg, eps, d = self.segments, self.eps, self._difference()
        limit = torch.finfo(d.dtype).max / 16
        d2 = d.square().clamp_(max=limit)
        first = self.waiting and self._start_scale(d2)
        distance = seg.mean(d2 / self.state["scale"])
        replaced = self._restart_replaced() if first or self._is_far(distance, d2) else None
        if replaced is not None:
            d2 = self._difference().square().clamp_(max=limit)
            self._start_scale(d2)
            distance = seg.mean(d2 / self.state["scale"])
        v, nu = self.state["scale"], self.state["nu"]
        share, new_nu = robust_rate(distance, nu, tau, self.k, eps)
        floor = floor_target(d2, v, seg.expand(distance), seg.expand(nu.reciprocal()), eps)
        rate = seg.expand(share.mul_(tau))
        v.addcmul_(rate, d2.add_(floor).sub_(v))
        if tau == 1:
            v.clamp_(min=eps**2)  # where v was much larger, the rounding of it may have left nothing
        nu.copy_(new_nu)
        followed, followed_views = self.buffers[1]
        torch.mul(rate, d, out=followed)
        torch._foreach_add_(self.target, followed_views)
        for copy, target in self.copies:
            copy.copy_(target)
        if strength:  # strength (tau - t) d, by what was not followed
            d.mul_(tau).sub_(followed)
            if self.alone is not None:
                d.masked_fill_(self.alone, 0.0)  # a member that is not rated by its target is left alone
            torch._foreach_sub_(self.source, self.buffers[0][1], alpha=strength)
        return replaced

    def _native_step(self, tau: float, strength: float) -> bool:
        """The same by the native kernels, where they are used and no tensor may have been replaced; whether it was."""
        kernels = native.active()
        if kernels is not None and self.waiting and bool(self.state["started"].all()):
            self.waiting = False  # as after a load
        if kernels is None or self.waiting or not updates.are_plain(*self.source, *self.target):
            return False
        if self.layout is None:
            self.layout = updates.Layout(self.segments.sizes, self.segments.counts)
        distance = torch.empty_like(self.state["nu"])
        updates.cat_distance(kernels, self.layout, self.source, self.target, self.state["scale"], distance)
        if not distance.max().item() <= _FAR:
            return False
        options = (tau, strength, self.eps, self.k)
        updates.cat(kernels, self.layout, self.source, self.target, self.state, distance, self.members, options)
        for copy, target in self.copies:
            copy.copy_(target)
        return True

    def _is_far(self, distance: Tensor, d2: Tensor) -> bool:
        """Whether a tensor is as far from its target as others would be: cheap, for every step."""
        # To read it back costs nothing on a CPU, and would stall a GPU.
        if distance.device.type != "cpu" or not distance.max().item() > _FAR:
            return False
        if self.spread is None:
            flat = self.segments.flatten(self.target)
            self.spread = self.segments.mean((flat - self.segments.expand(self.segments.mean(flat))).square_())
        return bool(((self.segments.mean(d2) > 0.1 * self.spread) & (self.spread > 0)).any())

    def _restart_replaced(self) -> Tensor | None:
        replaced = replaced_members(self.segments, self.source, self.target).view(self.batch_shape)
        if not replaced.any():
            return None
        self.restart(replaced)
        return replaced

    def restart(self, members: Tensor) -> None:
        """Starts the target of some members anew at their parameters.

        Args:
            members: which, ``[*B]`` bool.
        """
        for source, target in self.everything:
            target.copy_(torch.where(_rows(members, target), source, target))
        state = self._started(self.state["scale"])
        for name, x in self.views(state).items():
            for new, old in zip(x, self.views(self.state)[name], strict=True):
                old.copy_(torch.where(_rows(members, old), new, old))
        self.waiting, self.spread = True, None

    def changed(self, before: Mapping[str, Any]) -> Tensor:
        """Members ``[*B]`` of which some parameter differs from a snapshot."""
        batch_dims = len(self.batch_shape)
        changed = torch.zeros(self.batch_shape, dtype=torch.bool, device=self.target[0].device)
        for (source, _), old in zip(self.everything, before["source"], strict=True):
            old = old.to(source.device)
            differs = (source != old) & ~((source != source) & (old != old))  # NaN equals NaN
            changed |= differs.reshape(*self.batch_shape, -1).any(batch_dims)
        return changed

    def snapshot(self) -> dict[str, Any]:
        """Copies of the parameters, the target and the state."""
        return {
            "source": [source.detach().clone() for source, _ in self.everything],
            "target": [target.clone() for _, target in self.everything],
            "state": {name: x.clone() for name, x in self.state.items()},
            "waiting": self.waiting,
        }

    def restore(self, before: Mapping[str, Any], *, target: bool = True) -> None:
        """Brings back the state of a snapshot, and the target."""
        if target:
            for (_, x), old in zip(self.everything, before["target"], strict=True):
                x.copy_(old)
        for name, x in self.state.items():
            x.copy_(before["state"][name])
        self.waiting = before["waiting"]

    def views(self, state: Mapping[str, Tensor] | None = None) -> dict[str, list[Tensor]]:
        """Views of a state's entries, one a tensor."""
        seg, state = self.segments, self.state if state is None else state
        return {name: (seg.scalar_views if name in _SCALARS else seg.views)(x) for name, x in state.items()}

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Copies of the state by name and dotted key."""
        return {
            name: {key: x.clone() for key, x in zip(self.names, views, strict=True)}
            for name, views in self.views().items()
        }

    def load(self, group: str, state: Mapping[str, Mapping[str, Tensor]], check_only: bool) -> None:
        """Checks or copies a state."""
        for name, views in self.views().items():
            for key, x in zip(self.names, views, strict=True):
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
