"""A scripted tele-operator that flips pages by moving a leader arm, with human-like faults.

The operator sees the pages. Its hand moves a leader along strokes; the follower is pulled along by a virtual coupling,
so that the follower's forces arise from contact, friction and drag. World frame of
:mod:`torchrl_tsallis.envs.page_flip`; m, s, N, rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from torchrl_tsallis._checks import check_seed

STIFFNESS, DAMPING = 120.0, 1.0  # N/m and N s/m, of the coupling
RATE = 50  # Hz
FORCE_LIMIT = 3.3  # N


@dataclass(frozen=True)
class Style:
    """Habits of the hand during one trajectory.

    Args:
        speed: multiple of the nominal speed (1).
        height_bias: aim above the middle of the gap below the top page, m (0).
        height_noise: standard deviation of the aim's height from stroke to stroke, m (0.0005).
        lateral: place along the ring, m (0).
        approach: distance from the page's edge at which a stroke starts, m (0.016).
        radius: of the lifting arc about the ring, m (0.082).
        tremor: amplitude of the hand's tremor, m (0.0003).
        tremor_rate: Hz (9).
        wander: standard deviation of slow errors of 0.5 s, m (0.0004).
        hesitates: probability of a pause within a stroke (0.15).
        misses: probability of an off-target stroke, above or beside the page (0.06).
        releases: probability of letting a page go too early (0.05).
    """

    speed: float = 1.0
    height_bias: float = 0.0
    height_noise: float = 0.0005
    lateral: float = 0.0
    approach: float = 0.016
    radius: float = 0.082
    tremor: float = 0.0003
    tremor_rate: float = 9.0
    wander: float = 0.0004
    hesitates: float = 0.15
    misses: float = 0.06
    releases: float = 0.05


def draw_style(rng: np.random.Generator) -> Style:
    """Draws the habits of one trajectory."""
    return Style(
        speed=rng.uniform(0.85, 1.2),
        height_bias=0.0003 * rng.standard_normal(),
        lateral=rng.uniform(-0.008, 0.008),
        approach=rng.uniform(0.013, 0.02),
        radius=rng.uniform(0.078, 0.086),
        tremor=rng.uniform(0.0001, 0.0006),
        tremor_rate=rng.uniform(8.0, 10.0),
        wander=rng.uniform(0.0002, 0.0008),
    )


@dataclass(frozen=True)
class Stroke:
    """One attempt to flip a page.

    Args:
        path: the leader's positions at 50 Hz, ``[n, 3]`` in m.
        pause: rows in which the hand hesitates, ``[n]`` bool.
        lift: row at which the lifting begins.
        release: row at which the page is let go.
        off_target: whether the stroke aims beside the page.
    """

    path: np.ndarray
    pause: np.ndarray
    lift: int
    release: int
    off_target: bool


def _ease(duration: float) -> np.ndarray:
    """Minimum-jerk progress from 0 to 1 at 50 Hz, without the start, ``[n]``."""
    s = np.arange(1, max(1, round(duration * RATE)) + 1) / max(1, round(duration * RATE))
    return s**3 * (10 - 15 * s + 6 * s * s)


def _line(start: np.ndarray, end: np.ndarray, duration: float) -> np.ndarray:
    return start + _ease(duration)[:, None] * (end - start)


def _arc(start: np.ndarray, radius: float, angle: float, duration: float) -> np.ndarray:
    """From a point to a radius in m and an angle in rad about the ring, ``[n, 3]``."""
    s = _ease(duration)
    r0, a0 = math.hypot(start[0], start[2]), math.atan2(start[2], start[0])
    r, a = r0 + s * (radius - r0), a0 + s * (angle - a0)
    return np.stack([r * np.cos(a), np.full_like(s, start[1]), r * np.sin(a)], 1)


def plan_stroke(rng: np.random.Generator, style: Style, start: np.ndarray, edges: np.ndarray) -> Stroke:
    """Plans reach, insertion, lift and return for the top page of the right stack.

    Args:
        rng: source of the variety.
        style: the hand's habits.
        start: the leader's position, ``[3]`` in m.
        edges: free edges of the pages on the right, ``[n, 2]`` (x, z) in m, the top page last.

    Returns:
        The stroke.

    Examples:
        >>> edges = np.array([[0.104, 0.010], [0.104, 0.012]])
        >>> stroke = plan_stroke(np.random.default_rng(0), Style(misses=0.0), np.array([0.12, 0.0, 0.04]), edges)
        >>> stroke.path.shape[1], stroke.off_target
        (3, False)
    """
    speed = style.speed * (1 + 0.08 * np.clip(rng.standard_normal(), -2, 2))
    x, top = edges[-1]
    gap = float(np.clip(top - edges[-2, 1], 0.0, 0.004)) if len(edges) > 1 else 0.002
    height = top - gap / 2 + style.height_bias + style.height_noise * rng.standard_normal()
    off_target = bool(rng.random() < style.misses)
    if off_target:  # over the page, or short of it
        over = rng.random() < 0.6
        height, x = height + over * rng.uniform(0.006, 0.014), x + (not over) * rng.uniform(0.02, 0.03)
    y = style.lateral + 0.002 * rng.standard_normal()
    begin = np.array([x + style.approach, y, height])
    angle = rng.uniform(1.8, 2.2) if rng.random() >= style.releases else rng.uniform(1.0, 1.3)
    parts = [_line(start, begin, 0.4 / speed)]
    pauses = [np.zeros(len(parts[0]), dtype=bool)]

    def add(path: np.ndarray, pause: bool = False) -> None:
        parts.append(path)
        pauses.append(np.full(len(path), pause))

    def hold(duration: float, pause: bool) -> None:
        add(np.repeat(parts[-1][-1:], round(duration * RATE), 0), pause)

    hesitates, where = rng.random() < style.hesitates, rng.integers(3)
    hold(rng.uniform(0.0, 0.2) / speed, False)
    if hesitates and where == 0:
        hold(rng.uniform(0.2, 0.7), True)
    add(_line(parts[-1][-1] if len(parts[-1]) else begin, np.array([x - 0.012, y, height + 0.003]), 0.22 / speed))
    if hesitates and where == 1:
        hold(rng.uniform(0.2, 0.7), True)
    lift = sum(map(len, parts))
    add(_arc(parts[-1][-1], style.radius, angle, 0.6 / speed))
    release = sum(map(len, parts))
    if hesitates and where == 2:
        hold(rng.uniform(0.2, 0.7), True)
    add(_arc(parts[-1][-1], rng.uniform(0.105, 0.118), rng.uniform(0.45, 0.65), 0.45 / speed))
    return Stroke(np.concatenate(parts), np.concatenate(pauses), lift, release, off_target)


class FlipOperator:
    """The operator of one trajectory.

    Args:
        seed: of its habits and of all its errors.
        style: the habits. Default: drawn.

    Attributes:
        strokes: the strokes so far.
        begins: step at which each began.
    """

    def __init__(self, seed: int, style: Style | None = None) -> None:
        self._rng = np.random.default_rng([check_seed("seed", seed, low=0), 0xF11B])
        self.style = style if style is not None else draw_style(self._rng)
        self.strokes: list[Stroke] = []
        self.begins: list[int] = []
        self._step, self._wander = 0, np.zeros(3)
        self._phase = self._rng.uniform(0, 2 * math.pi, 3)
        self._hand = np.zeros(3)
        self._leader: np.ndarray | None = None

    def act(self, observation: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """One command of the coupling.

        Args:
            observation: of the environment, ``[12]``.
            edges: free edges of all pages, ``[pages, 2]`` (x, z) in m, the bottom page first.

        Returns:
            The follower's force, ``[3]`` float32 in N.
        """
        position = np.asarray(observation[:3], dtype=np.float64)
        velocity = (position - observation[6:9]) * RATE
        if self._leader is None:
            self._hand = self._leader = position
        leader = self._aim(edges) + self._shake()
        force = STIFFNESS * (leader - position) + DAMPING * ((leader - self._leader) * RATE - velocity)
        self._leader = leader
        self._step += 1
        norm = float(np.linalg.norm(force))
        return (force * min(1.0, FORCE_LIMIT / max(norm, 1e-9))).astype(np.float32)

    def _aim(self, edges: np.ndarray) -> np.ndarray:
        """The hand's intended position, ``[3]`` in m."""
        if not self.strokes or self._step >= self.begins[-1] + len(self.strokes[-1].path):
            right = edges[np.arctan2(edges[:, 1], edges[:, 0]) < 0.6]
            right = right[right[:, 0] > 0]
            if len(right) == 0:  # nothing is left to flip
                return self._hand
            self.strokes.append(plan_stroke(self._rng, self.style, self._hand, right))
            self.begins.append(self._step)
        self._hand = self.strokes[-1].path[self._step - self.begins[-1]]
        return self._hand

    def _shake(self) -> np.ndarray:
        """Tremor and slow wander, ``[3]`` in m."""
        keep = math.exp(-1 / (0.5 * RATE))
        kick = self.style.wander * math.sqrt(1 - keep**2)
        self._wander = keep * self._wander + kick * self._rng.standard_normal(3)
        time = self._step / RATE
        return self._wander + self.style.tremor * np.sin(2 * math.pi * self.style.tremor_rate * time + self._phase)
