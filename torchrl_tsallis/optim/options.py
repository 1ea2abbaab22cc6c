"""Checks of an optimizer's parameters and options: what is wrong is named before the first step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_tsallis._checks import check_number

__all__ = ["check_group", "check_params"]


def check_params(params: Any) -> list[Any]:
    """The parameters, or groups of them, as a list that an optimizer takes.

    Args:
        params: tensors, ``(name, tensor)`` pairs, or groups with an entry ``params`` of them.

    Returns:
        All of them.

    Raises:
        TypeError: for anything else.
        ValueError: if there are none.

    Examples:
        >>> check_params([])
        Traceback (most recent call last):
        ...
        ValueError: params is empty: pass the parameters that are trained, as loss.parameters()
    """
    wanted = "params must be the parameters that are trained, as loss.parameters(), or groups of them, {'params': ...}"
    if isinstance(params, (Tensor, np.ndarray, nn.Module, str, dict)) or not isinstance(params, Iterable):
        raise TypeError(f"{wanted}, got {'None' if params is None else type(params).__name__}")
    params = list(params)
    if not params:
        raise ValueError("params is empty: pass the parameters that are trained, as loss.parameters()")
    groups = params if isinstance(params[0], dict) else [{"params": params}]
    for group in groups:
        members = group.get("params") if isinstance(group, dict) else None
        if isinstance(members, Tensor):
            continue
        if isinstance(members, (nn.Module, str, dict)) or not isinstance(members, Iterable):
            got = f"of keys {sorted(map(str, group))}" if isinstance(group, dict) else repr(type(group).__name__)
            raise TypeError(f"{wanted}, got a group {got}")
        group["params"] = members = list(members)
        for p in members:
            if not isinstance(p[1] if isinstance(p, tuple) and len(p) == 2 else p, Tensor):
                raise TypeError(f"{wanted}, got a {type(p).__name__} among them")
    return params


def check_group(group: dict[str, Any]) -> None:
    """Checks a group of AdaTerm's, and turns its numbers into Python's own, as checkpoints take them.

    Args:
        group: the parameters and every option; a learning rate that is a tensor stays one.

    Raises:
        TypeError: for an option of the wrong type.
        ValueError: for an option outside of its range, and for parameters that do not fit.
    """
    lr = check_number("lr", group["lr"], low=0)
    group["lr"] = group["lr"] if isinstance(group["lr"], Tensor) else lr
    betas = group["betas"]
    three = f"betas must be three numbers (of the first moment, the second, the degrees of freedom), got {betas!r}"
    if isinstance(betas, str) or not isinstance(betas, Sequence):
        raise TypeError(three)
    if len(betas) != 3:
        raise ValueError(three)
    first, second, nu = betas
    group["betas"] = (
        check_number("betas[0]", first, low=0, below=1),
        check_number("betas[1]", second, low=0, below=1),
        check_number("betas[2]", nu, low=0, high=1),
    )
    group["eps"] = check_number("eps", group["eps"], above=0)
    group["k"] = k = check_number("k", group["k"], above=0, finite=False)  # inf switches the robustness off
    group["weight_decay"] = check_number("weight_decay", group["weight_decay"], low=0)
    group["amsgrad"] = check_number("amsgrad", group["amsgrad"], low=0, high=1)
    if group["ini_dof"] is not None:
        group["ini_dof"] = check_number("ini_dof", group["ini_dof"], low=k, finite=not math.isinf(k))
    dims = group["batch_dims"]
    # Whether there are members is the number of their dimensions.
    group["batch_dims"] = int(dims) if isinstance(dims, bool) else check_number("batch_dims", dims, low=0, integer=True)
    for name in ("uncentered", "adaptive_bias", "skip_nonfinite"):
        if not isinstance(group[name], bool):
            raise TypeError(f"{name} must be True or False, got {group[name]!r}")
    for p in group["params"]:
        if p.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"parameters must be float32 or float64, got {p.dtype}; keep a float32 copy of them")
        if p.ndim < group["batch_dims"]:
            raise ValueError(
                f"a parameter of shape {tuple(p.shape)} has fewer than batch_dims = {group['batch_dims']} dimensions; "
                "put it in a group of its own with batch_dims=0"
            )
