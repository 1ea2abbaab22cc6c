"""Figures as SVG inside a page: its colours, no names from outside, nothing that could be loaded."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

#: Colours of figures -> those of the page, which has others in the dark.
INK, MUTED, LINE, BLUE, ORANGE = "#1b1b1c", "#6b6f76", "#d9dce0", "#0072b2", "#c14f00"
_OF_PAGE = {
    INK: "currentColor",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
    BLUE: "var(--blue)",
    ORANGE: "var(--orange)",
}

#: Settings of matplotlib under which figures are made and saved.
STYLE: Any = {
    "svg.fonttype": "none",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": False,
}


def inline_svg(figure: Any, name: str, title: str) -> str:
    """A matplotlib figure as an ``<svg>`` element for a page.

    Args:
        figure: made under :data:`STYLE`; its texts are the program's own, not the user's.
        name: unique in the page; the element's ids begin with it.
        title: what is seen, for those who do not see it.

    Returns:
        The element, without size: the page gives it.
    """
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context(STYLE | {"svg.hashsalt": name}):
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'\s(xmlns(:\w+)?|version)="[^"]*"', "", text).replace("xlink:href", "href")
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    text = re.sub(r'\sid="([^"]*)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font: \1 sans-serif", text)
    for colour, of_page in _OF_PAGE.items():
        text = text.replace(colour, of_page)
    text = re.sub(r"\n\s*", "\n", text).strip()
    head = re.match(r"<svg[^>]*>", text)
    box = re.search(r'viewBox="[^"]*"', head[0]) if head else None
    if head is None or box is None:
        raise RuntimeError("matplotlib wrote an SVG of another form: its version is not one of those that are tested")
    said = html.escape(title)
    return f'<svg {box[0]} role="img" aria-label="{said}"><title>{said}</title>{text[head.end() :]}'


def thin(values: np.ndarray, most: int) -> np.ndarray:
    """At most so many values, each the largest of its part: peaks stay.

    Args:
        values: ``[T]``; NaN counts as 0.
        most: number of parts.

    Examples:
        >>> thin(np.array([1.0, 5.0, 2.0, np.nan, 3.0]), 2).tolist()
        [5.0, 3.0]
    """
    filled = np.nan_to_num(values, nan=0.0)
    return np.array([part.max() for part in np.array_split(filled, min(most, len(filled)))])


def sparkline(values: np.ndarray, limit: float, title: str, *, width: int = 120, height: int = 26) -> str:
    """A line of an episode's surprise without axes.

    Args:
        values: ``[T]``.
        limit: value at the upper edge, which is the same for all.
        title: for those who do not see it.
        width: in pixels.
        height: in pixels.
    """
    points = thin(values, 60)
    x = np.linspace(1, width - 1, len(points)) if len(points) > 1 else np.array([width / 2])
    y = height - 2 - (height - 4) * np.clip(points / limit, 0, 1)
    path = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(x, y, strict=True))
    said = html.escape(title)
    return (
        f'<svg class="spark" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
        f'aria-label="{said}"><title>{said}</title>'
        f'<polyline points="0,{height - 2} {path} {width},{height - 2}"/></svg>'
    )


def spread(values: Sequence[float] | np.ndarray, parts: int) -> np.ndarray:
    """Maxima of equal parts of an episode, ``[parts]``; short episodes repeat theirs.

    Examples:
        >>> spread([1.0, 3.0], 4).tolist()
        [1.0, 1.0, 3.0, 3.0]
    """
    filled = np.nan_to_num(np.asarray(values, dtype=float), nan=0.0)
    if len(filled) >= parts:
        return thin(filled, parts)
    return filled[np.arange(parts) * len(filled) // parts]
