"""The page of modes, and its drawings."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("matplotlib")

from torchrl_tsallis.report.figures import new_figure
from torchrl_tsallis.report.modes import COLOURS, colour_of, draw_differences, draw_modes, draw_together
from torchrl_tsallis.report.modes_page import most_different, write_modes_report
from torchrl_tsallis.report.svg import MUTED
from torchrl_tsallis.run import modes


def test_episodes_of_a_mode_stand_side_by_side_with_lines_between_modes():
    figure, (axes,) = new_figure(3, 3)
    pairs = np.array([[1.0, 0.0, 0.9], [0.0, 1.0, 0.1], [0.9, 0.1, 1.0]])
    draw_together(axes, pairs, np.array([0, 1, 0]), "policies")
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


def test_a_map_of_differences_has_time_from_left_to_right_and_a_row_a_dimension():
    figure, (axes,) = new_figure(4, 3)
    draw_differences(axes, np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]), ("#000000", "#ffffff"))
    assert axes.images[0].get_array().tolist() == [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]
    assert most_different(np.array([[0.0, 1.0], [2.0, 3.0]])).startswith(
        "most in dimension 1 of the action, from 50 to"
    )


def searched(folder, apart=1, **options):
    episode = torch.arange(80) // 10
    rows = {
        "observation": torch.rand(80, 2) + apart * (episode % 2)[:, None],
        "action": torch.rand(80, 1),
        "episode": episode,
    }
    data = TensorDict({**rows, "operator": episode % 2}, [80])
    return modes(data, folder, updates=2, progress=False, overwrite=True, **options)


def test_the_page_says_what_was_found_loads_nothing_and_is_written_beside_a_picture(tmp_path):
    found = searched(tmp_path / "modes", components=2, labels="operator")
    page = write_modes_report(tmp_path / "modes")
    text = page.read_text()
    assert (tmp_path / "modes" / "modes.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    large = [mode for mode in found.summary["modes"] if mode["episodes"] > 1]
    assert f"<h1>{len(large)} modes of behaviour" in text and found.summary["sentence"] in text
    assert "(imitate)" in text and "Your labels" in text and "<code>operator</code>" in text
    for part in ("http:", "https:", "src=", "<script", '<link rel="stylesheet'):
        assert part not in text
    assert text.count("<svg") == 2 + (len(large) * (len(large) - 1) // 2 if len(large) < 4 else 3)


def test_a_folder_with_its_page_may_be_replaced_and_one_with_more_may_not(tmp_path):
    searched(tmp_path / "modes", components=2, labels="operator")
    write_modes_report(tmp_path / "modes")
    searched(tmp_path / "modes")
    assert not (tmp_path / "modes" / "labels.csv").exists()
    (tmp_path / "modes" / "thesis.tex").write_text("")
    with pytest.raises(FileExistsError, match="holds more than a run .thesis.tex.: move that first"):
        searched(tmp_path / "modes")


def test_the_page_of_one_mode_compares_nothing(tmp_path):
    searched(tmp_path / "modes", apart=0)
    text = write_modes_report(tmp_path / "modes").read_text()
    assert "<h1>One mode of behaviour</h1>" in text
    assert "How they differ" not in text and "Your labels" not in text and "(imitate)" not in text


def test_names_from_the_data_are_escaped(tmp_path):
    searched(tmp_path / "modes", components=2)
    table = tmp_path / "modes" / "modes.csv"
    table.write_text(table.read_text().replace("0,0,", "0,<b>x</b>,", 1))
    assert "<b>x</b>" not in write_modes_report(tmp_path / "modes").read_text()


def test_a_broken_table_of_differences_is_named(tmp_path):
    searched(tmp_path / "modes", components=2)
    (tmp_path / "modes" / "differences.csv").write_text("mode,other\n0,1\n")
    with pytest.raises(ValueError, match="differences.csv' is broken"):
        write_modes_report(tmp_path / "modes")
