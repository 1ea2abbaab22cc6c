"""A linear layer whose parameters may be those of stacked members."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tsallis._checks import check_flag, shown
from torchrl_tsallis.modules.settings import check_dims, memory_for


class Linear(nn.Linear):
    """``torch.nn.Linear`` that also takes stacked parameters, ``[S, out, in]``, for inputs ``[S, *B, in]``.

    With ``stackable = True`` a module says that it does so. A network of such modules runs for S members at once by
    batched products, where others need ``torch.vmap``, whose overhead is that of a small network.

    Args:
        in_features: length of the input's last dimension.
        out_features: length of the output's.
        **kwargs: ``bias``, ``device`` and ``dtype``, as for ``torch.nn.Linear``.

    Raises:
        TypeError: for a length that is no integer.
        ValueError: for one under 1.

    Examples:
        >>> layer = Linear(3, 2)
        >>> params = {"weight": torch.zeros(4, 2, 3), "bias": torch.ones(4, 2)}
        >>> torch.func.functional_call(layer, params, torch.zeros(4, 5, 3)).shape
        torch.Size([4, 5, 2])
    """

    stackable = True

    def __init__(self, in_features: int, out_features: int, **kwargs: Any) -> None:
        check_dims(in_features=in_features, out_features=out_features)
        check_flag("bias", kwargs.get("bias", True))
        dtype = kwargs.get("dtype")
        if dtype is not None and not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
            raise TypeError(f"dtype must be a floating-point dtype such as torch.float32, got {shown(dtype)}")
        with memory_for(in_features=in_features, out_features=out_features):
            super().__init__(int(in_features), int(out_features), **kwargs)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[*B, in]`` to ``[*B, out]``."""
        if self.weight.ndim == 2:
            return super().forward(x)
        rows = x.reshape(len(self.weight), -1, x.shape[-1])
        if self.bias is None:
            out = torch.bmm(rows, self.weight.mT)
        else:
            out = torch.baddbmm(self.bias.unsqueeze(1), rows, self.weight.mT)
        return out.view(*x.shape[:-1], out.shape[-1])
