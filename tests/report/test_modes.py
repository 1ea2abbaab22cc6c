"""The picture of modes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("matplotlib")

from torchrl_tsallis.report.figures import new_figure
from torchrl_tsallis.report.modes import COLOURS, colour_of, draw_modes, draw_together, write_modes_picture
from torchrl_tsallis.report.svg import MUTED
from torchrl_tsallis.run import modes


def test_episodes_of_a_mode_stand_side_by_side_with_lines_between_modes():
    figure, (axes,) = new_figure(3, 3)
    pairs = np.array([[1.0, 0.0, 0.9], [0.0, 1.0, 0.1], [0.9, 0.1, 1.0]])
    draw_together(axes, pairs, np.array([0, 1, 0]))
    shown = axes.images[0].get_array()
    assert shown.tolist() == [[1.0, 0.9, 0.0], [0.9, 1.0, 0.1], [0.0, 0.1, 1.0]]
    assert [line.get_ydata()[0] for line in axes.lines[::2]] == [1.5]


def test_bars_have_the_colour_of_their_mode_and_an_episode_alone_is_grey():
    figure, (axes,) = new_figure(3, 3)
    draw_modes(axes, np.array([0, 1, 0]), np.array([0.8, 0.0, 0.8]))
    bars = axes.patches[:3]
    assert [bar.get_height() for bar in bars] == [0.8, 0.03, 0.8]
    assert bars[0].get_facecolor() == bars[2].get_facecolor() != bars[1].get_facecolor()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["mode 0: 2 episodes", "1 alone"]


def test_colours_end_in_grey():
    assert colour_of(len(COLOURS), 9) == MUTED and len(set(COLOURS)) == len(COLOURS)


def test_a_picture_is_written_beside_the_modes(tmp_path):
    rows = {"observation": torch.rand(80, 2), "action": torch.rand(80, 1), "episode": torch.arange(80) // 10}
    modes(TensorDict(rows, [80]), tmp_path / "modes", updates=2, components=2, progress=False)
    place = write_modes_picture(tmp_path / "modes")
    assert place.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    modes(TensorDict(rows, [80]), tmp_path / "modes", updates=2, progress=False, overwrite=True)
