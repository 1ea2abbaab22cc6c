"""Drawings of the modes among demonstrations: who belongs together, how sure that is, and how they differ."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_tsallis.report.svg import MUTED

#: Colours of the largest modes that can be told apart without seeing red and green; all others are grey.
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")

TITLES = {"policies": "how often together, over starts", "distributions": "how alike episodes are, from 0 to 1"}


def colour_of(mode: int, episodes: int) -> str:
    """Colour of a mode: grey for an episode alone, and for modes after the seventh.

    Examples:
        >>> colour_of(0, 5), colour_of(1, 1) == MUTED
        ('#0072b2', True)
    """
    return COLOURS[mode] if episodes > 1 and mode < len(COLOURS) else MUTED


def draw_together(axes: Any, pairs: np.ndarray, mode: np.ndarray, by: str) -> None:
    """How close two episodes are, with the episodes of a mode side by side.

    Args:
        axes: to draw on.
        pairs: ``[E, E]``, in [0, 1].
        mode: of each episode, ``[E]``.
        by: what modes were found by.
    """
    order = np.argsort(mode, kind="stable")
    image = axes.imshow(pairs[order][:, order], cmap="Blues", vmin=0, vmax=1, interpolation="none")
    for edge in np.flatnonzero(np.diff(mode[order])) + 0.5:
        axes.axhline(edge, color=MUTED, linewidth=0.5)
        axes.axvline(edge, color=MUTED, linewidth=0.5)
    axes.set(xlabel="episode, by mode", ylabel="episode, by mode", title=TITLES[by])
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def draw_modes(axes: Any, mode: np.ndarray, membership: np.ndarray) -> None:
    """Episodes in the order of the data: a bar in the colour of its mode, as high as its membership.

    Args:
        axes: to draw on.
        mode: of each episode, ``[E]``.
        membership: of each episode in its mode, ``[E]``.
    """
    count = np.bincount(mode)
    colours = [colour_of(k, count[k]) for k in mode.tolist()]
    # An episode alone has no membership: a stub says that it is there.
    axes.bar(np.arange(len(mode)), np.maximum(membership, 0.03), color=colours, width=0.9)
    axes.set(xlabel="episode, in the order of the data", ylabel="membership in its mode", ylim=(0, 1.02))
    shown = [k for k in range(min(len(count), len(COLOURS))) if count[k] > 1]
    for k in shown:
        axes.bar([0], [0], color=COLOURS[k], label=f"mode {k}: {count[k]} episodes")
    if (alone := int((count == 1).sum())) > 0:
        axes.bar([0], [0], color=MUTED, label=f"{alone} alone")
    axes.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.18), frameon=False)


def draw_differences(axes: Any, apart: np.ndarray, colours: tuple[str, str]) -> None:
    """Where two modes differ: dark where their policies would do other things.

    Args:
        axes: to draw on.
        apart: mean distance of the mean actions by part of an episode and dimension of the action, ``[T, A]``.
        colours: of the two, whose larger one is drawn above.
    """
    parts, dims = apart.shape
    image = axes.imshow(apart.T, aspect="auto", cmap="Greys", vmin=0, interpolation="none", extent=(0, 100, dims, 0))
    axes.set(xlabel="% of the episode", ylabel="dimension of the action")
    axes.set_yticks(np.arange(dims) + 0.5, range(dims), fontsize=8 if dims <= 12 else 4)
    for k, colour in enumerate(colours):
        axes.plot([50 * k, 50 * (k + 1)], [0, 0], color=colour, linewidth=5, clip_on=False, solid_capstyle="butt")
    axes.figure.colorbar(image, ax=axes, label="robust deviations")
