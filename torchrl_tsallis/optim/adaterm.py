"""AdaTerm: an Adam-like optimizer whose moments are robust to outlying gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from torchrl_tsallis import native
from torchrl_tsallis.native import updates
from torchrl_tsallis.optim.options import check_group, check_params
from torchrl_tsallis.optim.segments import Segments
from torchrl_tsallis.optim.student_t import floor_target, robust_rate

__all__ = ["AdaTerm"]


class AdaTerm(Optimizer):
    r"""Adaptive moments estimated under Student's t, so that outlying gradients are damped.

    Per parameter tensor with gradient ``g``, moments ``m``, ``s``, floor ``e`` and degrees of freedom ``nu``::

        d2 = (g - m)^2;  v = s + e;  D = mean(d2 / v);  w = (nu + 1) / (nu + D);  w_max = (nu + 1) / nu
        t1 = (1-beta1) w / w_max;  t2 = (1-beta2) w / w_max;  de = max(eps^2, (d2 - D v) / nu)
        m += t1 (g - m);  s += t2 (d2 - s);  e += t2 (de - e);  nu += t_nu (nu* - nu)
        theta -= lr (m / (1-beta1^t)) / sqrt((s + e) / (1-beta2^t))

    ``t_nu`` and ``nu*`` are those of :func:`torchrl_tsallis.optim.student_t.robust_rate`. ``D``, ``w`` and ``nu`` are
    scalars per tensor, or per ensemble member with ``batch_dims``. The state of a group is held in flat vectors, and
    all of its scalars in one tensor, so a step does not read anything back from the device.

    With ``amsgrad``, ``s`` is replaced by its decaying maximum in the last line (of ``s + m^2`` where uncentered), to
    which the floor ``e`` is added.

    State per parameter: ``step``, ``exp_avg`` (m), ``exp_avg_sq`` (s), ``floor`` (e), ``nu``, ``skipped`` (number of
    refused updates), and ``max_exp_avg_sq``, ``bias1``, ``bias2`` where the option asks for them.

    Source: Ilboudo, Kobayashi & Matsubara, "AdaTerm: Adaptive T-distribution Estimated Robust Moments for
    Noise-Robust Stochastic Gradient Optimization", Neurocomputing 2023, arXiv 2201.06714; in this project's reading.

    Args:
        params: parameters (float32 or float64) or parameter groups; each option below may differ by group.
        lr: learning rate. Default: 1e-3.
        betas: decay of the first moment and of the second, in [0, 1), and of the degrees of freedom, in [0, 1], where
            1 keeps them as they start. Default: (0.9, 0.9, 0.9).
        eps: square root of the variance's least floor. Default: 1e-5.
        k: lower bound of the degrees of freedom; ``inf`` switches the robustness off. Default: 1.0.
        weight_decay: factor of the parameters that is added to the gradient (L2, as in ``torch.optim.Adam``).
            Default: 0.
        amsgrad: decay in [0, 1] of the running maximum of the second moment; 0 is off, 1 never forgets. Default: 0.
        uncentered: divide by the uncentered second moment, ``s + e + m^2``. Default: False.
        adaptive_bias: correct the bias by the accumulated actual rates ``t1``, ``t2`` instead of powers of beta.
            Default: False.
        ini_dof: initial degrees of freedom, at least ``k``; less than ``k + eps`` starts there. Default: None, ``k``.
        batch_dims: number of leading ensemble dimensions of each parameter; members do not influence each other.
            Default: 0.
        skip_nonfinite: leave a tensor (or member) and its state as they are where its gradient is not finite.
            Default: True.

    Raises:
        TypeError: for an argument of the wrong type, such as None, or a truth value where a number is wanted.
        ValueError: for an argument outside of its range, for no parameters at all, and for parameters of another type
            or with too few dimensions.
        RuntimeError: for sparse gradients.

    Examples:
        >>> x = torch.nn.Parameter(torch.tensor([1.0, -2.0]))
        >>> optim = AdaTerm([x], lr=0.1)
        >>> for _ in range(1000):
        ...     optim.zero_grad()
        ...     x.square().sum().backward()
        ...     _ = optim.step()
        >>> bool((x.abs() < 0.2).all())
        True
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float, float] = (0.9, 0.9, 0.9),
        eps: float = 1e-5,
        k: float = 1.0,
        weight_decay: float = 0.0,
        amsgrad: float = 0.0,
        uncentered: bool = False,
        adaptive_bias: bool = False,
        ini_dof: float | None = None,
        batch_dims: int = 0,
        skip_nonfinite: bool = True,
    ) -> None:
        self._layouts: dict[tuple[Any, ...], _Layout] = {}
        names = ("betas", "eps", "k", "weight_decay", "amsgrad", "uncentered", "adaptive_bias", "ini_dof")
        values = (betas, eps, k, weight_decay, amsgrad, uncentered, adaptive_bias, ini_dof)
        rest = {"lr": lr, "batch_dims": batch_dims, "skip_nonfinite": skip_nonfinite}
        super().__init__(check_params(params), {**rest, **dict(zip(names, values, strict=True))})

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Adds a group of parameters with its own options, after checking them."""
        super().add_param_group(param_group)
        try:
            check_group(self.param_groups[-1])
        except (TypeError, ValueError):
            self.param_groups.pop()
            raise
        self._layouts.clear()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state of this optimizer.

        Args:
            state_dict: of an ``AdaTerm`` of as many parameters.

        Raises:
            ValueError: if it is of another optimizer, or its groups do not fit.
        """
        for group in state_dict.get("param_groups", ()):
            missing = [name for name in self.defaults if name not in group]
            if missing:
                raise ValueError(
                    f"the state dict is of another optimizer than AdaTerm: its groups have no {missing[0]!r}"
                )
        super().load_state_dict(state_dict)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a pickled or loaded state; the flat vectors are rebuilt at the next step."""
        super().__setstate__(state)
        self._layouts = {}

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Updates each parameter that has a gradient.

        Args:
            closure: recomputes the loss and its gradients. Default: None.

        Returns:
            The closure's loss, or None.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for index, group in enumerate(self.param_groups):
            active: dict[tuple[torch.dtype, torch.device], list[Tensor]] = {}
            for p in group["params"]:
                if p.grad is None or p.numel() == 0:
                    continue
                if p.grad.is_sparse:
                    raise RuntimeError("AdaTerm does not support sparse gradients; make the layer's gradient dense")
                active.setdefault((p.dtype, p.device), []).append(p)
            for kind, params in active.items():
                options = (group["amsgrad"] > 0, group["adaptive_bias"], group["batch_dims"])
                layout = self._layouts.get((index, kind))
                signature = (options, [id(p) for p in params])
                if layout is None or layout.signature != signature:
                    layout = self._layouts[(index, kind)] = _Layout(self.state, group, params, signature)
                layout.step(group, params)
        return loss


class _Layout:
    """Flat state of the active parameters of one group, data type and device; ``state`` holds views of it."""

    def __init__(
        self, state: dict[Any, dict[str, Any]], group: dict[str, Any], params: list[Tensor], signature: Any
    ) -> None:
        self.signature = signature
        self.segments = Segments(params, group["batch_dims"])
        self.flat: dict[str, Tensor] = {}
        self.limit = torch.finfo(params[0].dtype).max / 16
        self.grad, self.grad_views = self.segments.buffer(params[0])
        self.update, self.update_views = self.segments.buffer(params[0])
        self.zero = params[0].new_zeros(())
        self.layout = updates.Layout(self.segments.sizes, self.segments.counts)
        dof = max(group["k"] + group["eps"], group["ini_dof"] or 0.0)
        scalars = {"step": 0.0, "nu": dof, "skipped": 0.0}
        scalars |= {"bias1": 0.0, "bias2": 0.0} if group["adaptive_bias"] else {}
        vectors = {"exp_avg": 0.0, "exp_avg_sq": 0.0, "floor": group["eps"] ** 2}
        vectors |= {"max_exp_avg_sq": 0.0} if group["amsgrad"] else {}
        for name, start in {**scalars, **vectors}.items():
            shapes = self.segments.batch_shapes if name in scalars else self.segments.shapes
            parts = []
            for p, shape in zip(params, shapes, strict=True):
                part = state[p][name].to(p) if name in state[p] else p.new_full(shape, start)
                if part.shape != shape:
                    raise ValueError(
                        f"the optimizer's state {name!r} has shape {tuple(part.shape)}, its parameter of shape "
                        f"{tuple(p.shape)} needs {tuple(shape)}: the state dict is of another network"
                    )
                parts.append(part)
            flat = self.segments.flatten(parts)
            self.flat[name] = flat
            views = self.segments.scalar_views(flat) if name in scalars else self.segments.views(flat)
            for p, view in zip(params, views, strict=True):
                state[p][name] = view

    def step(self, group: dict[str, Any], params: list[Tensor]) -> None:
        """One update of the parameters from their gradients."""
        grads = [p.grad for p in params if p.grad is not None]
        kernels = native.active() if group["skip_nonfinite"] else None
        if kernels is not None and self._is_plain(group, params, grads):
            options = (group["lr"], *group["betas"], group["eps"], group["k"], group["weight_decay"])
            updates.adaterm(kernels, self.layout, params, grads, self.flat, [float(x) for x in options])
            return
        seg, f, (beta1, beta2, beta_nu), eps = self.segments, self.flat, group["betas"], group["eps"]
        m, s, floor, nu = f["exp_avg"], f["exp_avg_sq"], f["floor"], f["nu"]
        d = self.grad
        torch._foreach_copy_(self.grad_views, grads)
        if group["weight_decay"]:
            d.add_(seg.flatten(params), alpha=group["weight_decay"])
        d.sub_(m)
        d2 = d.square().clamp_(max=self.limit)
        v = s + floor
        ratio = d2 / v
        if group["skip_nonfinite"]:
            ratio.addcmul_(d, self.zero)  # NaN where the gradient is not finite; d2 was clamped and no longer shows it
        distance = seg.mean(ratio)
        bad = None
        # A sum of squares is NaN if one of them is. To read it back costs nothing on a CPU, and would stall a GPU.
        if group["skip_nonfinite"] and (distance.device.type != "cpu" or math.isnan(distance.sum().item())):
            bad = distance.isnan()
        if bad is not None:
            distance = distance.masked_fill(bad, 0.0)
            d.nan_to_num_(0.0, 0.0, 0.0)
            d2.nan_to_num_(0.0)
        share, new_nu = robust_rate(distance, nu, 1 - beta_nu, group["k"], eps)
        if bad is not None:
            share, new_nu = share.masked_fill(bad, 0.0), torch.where(bad, nu, new_nu)
            f["skipped"].add_(bad)
            f["step"].add_(~bad)
        else:
            f["step"].add_(1)
        de = floor_target(d2, v, seg.expand(distance), seg.expand(nu.reciprocal()), eps)
        share_flat = seg.expand(share)
        m.addcmul_(share_flat, d, value=1 - beta1)
        s.addcmul_(share_flat, d2.sub_(s), value=1 - beta2)
        floor.addcmul_(share_flat, de.sub_(floor), value=1 - beta2)
        nu.copy_(new_nu)
        if beta2 == 0:
            floor.clamp_(min=eps**2)  # where it was much larger, the rounding of it may have left nothing
        second = s
        if group["amsgrad"]:
            largest = f["max_exp_avg_sq"]
            moment = torch.addcmul(s, m, m).clamp_(max=self.limit) if group["uncentered"] else s
            second = torch.maximum(largest * group["amsgrad"], moment)
            if bad is not None:
                second = torch.where(seg.expand(bad), largest, second)
            largest.copy_(second)
        v = torch.add(second, floor, out=v)
        if group["uncentered"] and not group["amsgrad"]:
            v.addcmul_(m, m).clamp_(max=self.limit)
        scale = self._bias_correction(group, share, beta1, beta2) * group["lr"]
        if bad is not None:
            scale, v = scale.masked_fill(bad, 0.0), v.clamp_(min=torch.finfo(v.dtype).tiny)
        torch.mul(seg.expand(scale), m, out=self.update).div_(v.sqrt_())
        torch._foreach_sub_(params, self.update_views)

    @staticmethod
    def _is_plain(group: dict[str, Any], params: list[Tensor], grads: list[Tensor]) -> bool:
        """Whether the native kernel knows the options, and the tensors."""
        unknown = group["amsgrad"] > 0 or group["uncentered"] or group["adaptive_bias"]
        return not unknown and updates.are_plain(*params, *grads)

    def _bias_correction(self, group: dict[str, Any], share: Tensor, beta1: float, beta2: float) -> Tensor:
        """Returns ``sqrt(c2) / c1`` for the corrections c1, c2 of the two moments, ``[S]``."""
        f, tiny = self.flat, torch.finfo(share.dtype).tiny
        if group["adaptive_bias"]:
            c1, c2 = f["bias1"], f["bias2"]
            c1.add_((1 - beta1) * share * (1 - c1))
            c2.add_((1 - beta2) * share * (1 - c2))
            return c2.sqrt() / c1.clamp(min=tiny)
        c2 = -torch.expm1(f["step"] * math.log(max(beta2, tiny)))
        if beta1 == beta2:
            return c2.clamp_(min=tiny).rsqrt_()
        c1 = -torch.expm1(f["step"] * math.log(max(beta1, tiny)))
        return c2.sqrt() / c1.clamp(min=tiny)
