"""Folders of which something is missing, damaged or unusual."""

from __future__ import annotations

import html
import json
import re

import pytest

from torchrl_tsallis.report import write_report


def text_of(folder) -> str:
    """What the page says outside of its style, script and pictures."""
    page = write_report(folder).read_text(encoding="utf-8")
    page = re.sub(r"<(style|script)>.*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", "", page)).split())


@pytest.mark.parametrize(
    ("file", "text", "match"),
    [
        ("run.json", None, "run.json.*not there"),
        ("run.json", "{", "run.json.*broken"),
        ("summary.json", None, "summary.json.*not there"),
        ("summary.json", "[1]", "is list"),
        ("summary.json", "{}", "'usable'.*rate the data again"),
        ("summary.json", '{"usable": "yes"}', "'usable' of .*'yes'"),
        ("summary.json", '{"usable": true}', "'sentence'"),
        ("summary.json", '{"usable": true, "sentence": "x", "reasons": 3}', "'reasons'"),
        ("summary.json", '{"usable": true, "sentence": "x"}', "'agreement'"),
        ("summary.json", '{"usable": true, "sentence": "x", "agreement": {"spearman": "a"}}', "'agreement'"),
        ("episodes.csv", None, "episodes.csv.*not there"),
        ("episodes.csv", "a,b\n", "no column"),
        ("ratings.csv", "row,episode,step,surprise,rating,surprise_seen\n0,0,0,1", "cells"),
        ("ratings.csv", "", "no column"),
    ],
)
def test_missing_and_damaged_files_are_named(write_folder, file, text, match):
    folder = write_folder()
    (folder / file).unlink() if text is None else (folder / file).write_text(text)
    with pytest.raises((ValueError, FileNotFoundError), match=match):
        write_report(folder)
    assert not (folder / "report.html").exists() and not list(folder.glob("*.png"))


def test_damaged_numbers_of_the_summary_are_named(write_folder):
    for k, (key, value) in enumerate([("calibration", {"a": 1}), ("calibration", {"1": "x"}), ("findings", ["x"])]):
        with pytest.raises(ValueError, match=f"'{key}'"):
            write_report(write_folder(name=f"r{k}", **{key: value}))


def test_what_is_not_known_is_a_dash(write_folder):
    folder = write_folder(3, agreement={"spearman": None, "low": None, "high": None}, calibration={}, findings=[])
    rows = (folder / "episodes.csv").read_text().splitlines()
    head = "episode,source,steps,surprise"
    cells = [row.split(",")[:4] for row in rows[1:]]
    cells[1][3] = ""
    (folder / "episodes.csv").write_text("\n".join([head, *(",".join(row) for row in cells)]) + "\n")
    text = text_of(folder)
    assert "The agreement is not known" in text and "The checks of the data found nothing" in text
    assert "nan" not in text.lower() and not (folder / "calibration.png").exists()
    assert text.count("–") >= 4 and "0 of 3 episodes stand out" in text


def test_steps_and_episodes_without_a_surprise_do_not_break_it(write_folder):
    folder = write_folder(8)
    lines = (folder / "ratings.csv").read_text().splitlines()
    lines[1:40] = [",".join([*line.split(",")[:3], "", "", ""]) for line in lines[1:40]]
    (folder / "ratings.csv").write_text("\n".join(lines) + "\n")
    assert "nan" not in text_of(folder).lower()


def test_episodes_of_one_step(write_folder):
    folder = write_folder(4, steps=1)
    rows = (folder / "episodes.csv").read_text()
    assert "demo_3,1," in rows and "demo_3" in text_of(folder)


def test_data_in_memory_have_no_commands(write_folder):
    folder = write_folder()
    run = json.loads((folder / "run.json").read_text())
    run["data"] |= {"path": "", "format": "memory"}
    (folder / "run.json").write_text(json.dumps(run))
    text = text_of(folder)
    assert "The data were in memory" in text and "tsallis curate" not in text
