"""A linear layer whose parameters may be those of stacked members."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Linear(nn.Linear):
    """``torch.nn.Linear`` that also takes stacked parameters, ``[S, out, in]``, for inputs ``[S, *B, in]``.

    With ``stackable = True`` a module says that it does so. A network of such modules runs for S members at once by
    batched products, where others need ``torch.vmap``, whose overhead is that of a small network.

    Examples:
        >>> layer = Linear(3, 2)
        >>> params = {"weight": torch.zeros(4, 2, 3), "bias": torch.ones(4, 2)}
        >>> torch.func.functional_call(layer, params, torch.zeros(4, 5, 3)).shape
        torch.Size([4, 5, 2])
    """

    stackable = True

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
