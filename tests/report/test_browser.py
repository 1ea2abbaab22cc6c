"""The page in headless Chromium: it sorts, says no error and asks for nothing."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from torchrl_tsallis.report.modes_page import write_modes_report
from torchrl_tsallis.run import modes


def names(browser) -> list[str]:
    return browser.evaluate("[...document.querySelectorAll('.sortable tbody td.name')].map((cell) => cell.textContent)")


def numbers(browser, column: int) -> list[float]:
    script = f"[...document.querySelector('.sortable').tBodies[0].rows].map((row) => row.cells[{column}].dataset.v)"
    return [float(value) for value in browser.evaluate(script)]


def test_the_page_sorts_by_clicks_and_is_quiet(browser, reported):
    page = reported[1]
    browser.open(page.as_uri())
    before, by_surprise = names(browser), numbers(browser, 2)
    assert by_surprise == sorted(by_surprise, reverse=True) and len(before) == 12
    heads = "document.querySelector('.sortable').tHead.rows[0].cells"
    for column, first in ((5, "descending"), (1, "ascending"), (3, "descending")):
        for order in (first, {"descending": "ascending", "ascending": "descending"}[first]):
            browser.click(f"{heads}[{column}].querySelector('button')")
            assert browser.evaluate(f"{heads}[{column}].getAttribute('aria-sort')") == order
            assert browser.evaluate("document.querySelectorAll('[aria-sort]').length") == 1
            if column == 1:
                inner = [f"demo_{k}" for k in range(12)]  # 2 before 10
                assert names(browser) == (inner if order == "ascending" else inner[::-1])
            else:
                found = numbers(browser, column)
                assert found == sorted(found, reverse=order == "descending")
    browser.click(f"{heads}[0].querySelector('button')")
    assert names(browser) == before
    wide = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    assert browser.evaluate(wide)
    for width in (400, 320):
        browser.ask("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=True)
        assert browser.evaluate(wide), width
    paper = set()
    for scheme in ("light", "dark"):
        browser.ask("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        paper.add(browser.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert len(paper) == 2
    browser.evaluate("1")
    assert browser.asked() == [page.as_uri()]
    assert browser.faults() == []


def test_without_scripts_everything_is_there(browser, reported):
    browser.ask("Target.setDiscoverTargets", discover=False)
    browser.open("about:blank")
    browser.ask("Emulation.setScriptExecutionDisabled", value=True)
    browser.events.clear()
    browser.go(reported[1].as_uri())
    text = browser.evaluate("document.body.innerText")
    assert "Review queue" in text and "demo_11" in text and "tsallis curate" in text
    assert browser.evaluate("document.querySelectorAll('button').length") == 0


def test_the_page_of_modes_is_quiet_and_fits_a_phone(browser, tmp_path):
    rows = {"observation": torch.rand(80, 2), "action": torch.rand(80, 1), "episode": torch.arange(80) // 10}
    data = TensorDict({**rows, "operator": rows["episode"] % 2}, [80])
    modes(data, tmp_path / "modes", components=2, updates=2, labels="operator", progress=False)
    page = write_modes_report(tmp_path / "modes")
    browser.open(page.as_uri())
    for width in (1280, 400, 320):
        browser.ask("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=True)
        assert browser.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"), width
    text = browser.evaluate("document.body.innerText")
    assert "Who belongs together" in text and "operator" in text and "tsallis train" in text
    assert browser.asked() == [page.as_uri()]
    assert browser.faults() == []
