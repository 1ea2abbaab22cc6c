"""The page in headless Chromium, spoken to through its debugging pipe: it sorts, says no error and asks for nothing."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")


class Browser:
    """Sends commands and keeps events."""

    def __init__(self, profile) -> None:
        read, self.to = os.pipe()
        self.back, write = os.pipe()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1280,900"]
        options += [f"--user-data-dir={profile}", "--no-first-run", "--disable-background-networking"]
        self.process = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{read} 4>&{write}', "-", CHROMIUM, *options, "--remote-debugging-pipe"],
            pass_fds=(read, write), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read)
        os.close(write)
        self.buffer, self.number, self.events, self.session = b"", 0, [], None

    def message(self) -> dict:
        while b"\0" not in self.buffer:
            assert select.select([self.back], [], [], 60)[0], "Chromium says nothing"
            part = os.read(self.back, 2**16)
            assert part, "Chromium has ended"
            self.buffer += part
        text, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(text)

    def ask(self, method: str, **parameters):
        self.number += 1
        question = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            question["sessionId"] = self.session
        os.write(self.to, json.dumps(question).encode() + b"\0")
        while (answer := self.message()).get("id") != self.number:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def evaluate(self, script: str):
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def open(self, address: str) -> None:
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.ask(f"{domain}.enable")
        self.ask("Page.navigate", url=address)
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self.message())

    def click(self, element: str) -> None:
        self.evaluate(f"{element}.scrollIntoView({{block: 'center', inline: 'center'}})")
        place = self.evaluate(
            f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({element}.getBoundingClientRect())"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.ask("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", clickCount=1)

    def close(self) -> None:
        self.session = None
        self.ask("Browser.close")
        self.process.wait(30)
        os.close(self.to)
        os.close(self.back)


@pytest.fixture
def browser(tmp_path):
    found = Browser(tmp_path / "profile")
    try:
        yield found
        found.close()
    finally:
        if found.process.poll() is None:
            found.process.kill()
            found.process.wait()


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
    asked = [e["params"]["request"]["url"] for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    assert [address for address in asked if not address.startswith("data:")] == [page.as_uri()]
    wrong = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded", "Network.loadingFailed")
    assert [event for event in browser.events if event["method"] in wrong] == []


def test_without_scripts_everything_is_there(browser, reported):
    browser.ask("Target.setDiscoverTargets", discover=False)
    browser.open("about:blank")
    browser.ask("Emulation.setScriptExecutionDisabled", value=True)
    browser.events.clear()
    browser.ask("Page.navigate", url=reported[1].as_uri())
    while not any(event["method"] == "Page.loadEventFired" for event in browser.events):
        browser.events.append(browser.message())
    text = browser.evaluate("document.body.innerText")
    assert "Review queue" in text and "demo_11" in text and "tsallis curate" in text
    assert browser.evaluate("document.querySelectorAll('button').length") == 0
