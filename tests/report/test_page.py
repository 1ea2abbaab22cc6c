"""The page holds what the folder says, loads nothing, and lets nothing of the user's data become markup."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest

from torchrl_tsallis.report import page as page_module
from torchrl_tsallis.report import write_report

HOSTILE = ["<script>alert(1)</script>", "a\" onload='x'&amp;", "$\\frac{", "{{ 7 * 7 }}", "猫/\u202eevil", "x" * 300]
VOID = {"meta", "link", "br", "img"}


class Page(HTMLParser):
    """Elements with their attributes, texts, and a check that they nest."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        assert len(dict(attributes)) == len(attributes), (tag, attributes)
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.texts.append(data.strip())

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def all(self, *tags):
        return [attributes for tag, attributes in self.elements if tag in tags]


def read(folder) -> Page:
    return Page(write_report(folder).read_text(encoding="utf-8"))


def test_the_page_loads_nothing_and_its_pictures_are_described(reported):
    page = Page(reported[1].read_text(encoding="utf-8"))
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            if name in ("src", "href", "xlink:href", "data", "srcset", "action", "poster"):
                assert value.startswith(("#", "data:")), (tag, name, value)
            assert not name.startswith("on") and "://" not in str(value), (tag, name, value)
            assert not re.search(r"url\((?!#)", str(value)), (tag, name, value)
    assert not page.all("iframe", "object", "embed", "base", "form")
    svgs = page.all("svg")
    assert len(svgs) == 12 + 4 + 6 + 6  # sparklines, pictures of all, single episodes, signals
    assert all(svg["role"] == "img" and svg["aria-label"] for svg in svgs)
    assert len(page.all("title")) == 1 + len(svgs)
    style = page_module.resources.files("torchrl_tsallis.report").joinpath("page.css").read_text()
    assert "url(" not in style and "@import" not in style and "prefers-color-scheme: dark" in style


def test_ids_are_unique_and_references_meet_them(reported):
    page = Page(reported[1].read_text(encoding="utf-8"))
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for _, attributes in page.elements:
        for value in attributes.values():
            for target in re.findall(r"^#(.+)$|url\(#(.+?)\)", value or ""):
                assert "".join(target) in ids


def test_no_colour_is_fixed_where_the_scheme_may_be_dark(reported):
    text = reported[1].read_text(encoding="utf-8")
    body = text[text.index("<main>") :]
    assert not re.search(r"(fill|stroke): ?#(?!none)|(fill|stroke)=\"#|: (black|white)", body)
    assert "var(--blue)" in body and "currentColor" in body


def test_parts_are_in_order_and_the_verdict_is_first(reported):
    folder = reported[0]
    page = Page(reported[1].read_text(encoding="utf-8"))
    assert [a["id"] for a in page.all("section")] == ["usable", "queue", "all", "single", "signals", "faults", "run"]
    for earlier, later in zip(
        ("Look first at demo_11", "Look before you delete", "rank correlation of 0.8", "Is the rating usable?"),
        ("Look before you delete", "rank correlation of 0.8", "Is the rating usable?", "Review queue"),
        strict=True,
    ):
        assert page.text.index(earlier) < page.text.rindex(later)
    assert "not a list of bad episodes or of bad people" in page.text and "3 of 12 episodes stand out" in page.text
    for command in (
        f"tsallis curate {folder} --out 'my demos_curated.npz' --share 0.09 --dry-run",
        f"tsallis curate {folder} --out 'my demos_curated.npz' --list keep.json",
    ):
        assert command in page.text
    kept = json.loads(re.search(r"\[\"demo_.*?\]", page.text)[0])
    assert kept == [f"demo_{k}" for k in range(9)]
    assert len([a for a in page.all("tr") if a.get("class") == "marked"]) == 3
    assert "State tells action" in page.text and "Does not see" in page.text and "Return" not in page.text


def test_no_verdict_where_the_rating_is_not_usable(write_folder):
    page = read(write_folder(usable=False))
    assert page.text.index("No verdict, because") < page.text.index("the seeds do not agree <b>at all</b>")
    assert "Look first at" not in page.text and "Look before you delete" not in page.text
    assert "--share" not in page.text and "--list keep.json" in page.text and "keep.json with all" not in page.text
    assert (
        not [a for a in page.all("tr") if a.get("class")]
        and "The rating is not usable: the order may be chance" in page.text
    )


def test_names_from_files_stay_text(write_folder):
    folder = write_folder(len(HOSTILE) + 4, names=[*"abcd", *HOSTILE])
    text = write_report(folder).read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.all("script")) == 1 and not page.all("b", "i", "x")
    titles = [a.get("title") for a in page.all("td") if a.get("class") == "name"]
    assert set(titles) == {*"abcd", *HOSTILE}
    assert "tsallis rate <x>" in page.text and "3 rows <i>stand</i>" in page.text
    assert "{{ 7 * 7 }}" in page.text and "49" not in [t for t in page.texts if t.endswith("49")]


def test_a_hundred_episodes_are_less_than_a_megabyte_and_thousands_are_cut(write_folder):
    assert write_report(write_folder(100, steps=300)).stat().st_size < 1e6
    page = read(write_folder(450, steps=10, name="many"))
    assert "The 200 most surprising of 450 episodes" in page.text
    assert len(page.all("tr")) == 1 + 200 + 1 + 1 + 11  # heads, episodes, a finding, facts


def test_pictures_lie_beside_it_and_no_half_of_anything(write_folder, monkeypatch):
    folder = write_folder()
    first = write_report(folder).read_bytes()
    pictures = {"strip", "agreement", "calibration", "histogram", "worst", "signals"}
    assert {file.stem for file in folder.glob("*.png")} == pictures
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in folder.glob("*.png"))
    assert write_report(folder).read_bytes() == first  # the same again

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    before = {file: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.setattr(page_module.Path, "write_text", full)
    with pytest.raises(OSError, match="cannot write .*report.html.*No space left"):
        write_report(folder)
    assert {file.name for file in folder.iterdir()} == {file.name for file in before}
    assert (folder / "report.html").read_bytes() == first
