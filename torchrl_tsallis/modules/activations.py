"""Squareplus and Squish: smooth algebraic activations."""

from __future__ import annotations

from torch import Tensor, nn


def squareplus(x: Tensor) -> Tensor:
    r"""Algebraic softplus, :math:`(x + \sqrt{x^2 + 4}) / 2` (Barron, arXiv 2112.11687).

    For negative x the equal form :math:`2 / (\sqrt{x^2+4} - x)` is used, which does not cancel: the result is positive
    for every finite x that float32 can square.

    Args:
        x: any shape.

    Returns:
        A positive number for each entry.

    Examples:
        >>> import torch
        >>> squareplus(torch.tensor([0.0, -1e4]))
        tensor([1.0000e+00, 1.0000e-04])
    """
    root = (x.square() + 4).sqrt()
    # |x| rather than -x: the branch that is not taken must stay finite, or its gradient becomes 0 * inf.
    return ((x + root) / 2).where(x >= 0, 2 / (root + x.abs()))


def squish(x: Tensor) -> Tensor:
    r"""Swish with an algebraic sigmoid, :math:`x (1 + x / \sqrt{x^2 + 4}) / 2` (method of section V-B).

    The sigmoid is squareplus' derivative. The paper only cites Squish; this form is this project's reading.

    Args:
        x: any shape.

    Returns:
        The activation, same shape.

    Examples:
        >>> import torch
        >>> squish(torch.tensor([0.0, 1.5]))
        tensor([0.0000, 1.2000])
    """
    return x * (1 + x * (x.square() + 4).rsqrt()) / 2


class Squish(nn.Module):
    """:func:`squish` as a module.

    Examples:
        >>> import torch
        >>> Squish()(torch.tensor(1.5))
        tensor(1.2000)
    """

    def forward(self, x: Tensor) -> Tensor:
        """Applies the activation, any shape."""
        return squish(x)
