"""What every test leaves as it was, and a browser for those that look at pages."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess

import pytest
from torchrl import torchrl_logger

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(autouse=True)
def _same_log_level():
    """Recipes that run in a test make TorchRL's logger quieter, which would silence the warnings of later tests."""
    level = torchrl_logger.level
    yield
    torchrl_logger.setLevel(level)


class Browser:
    """Headless Chromium, spoken to through its debugging pipe: sends commands and keeps events."""

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
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def open(self, address: str) -> None:
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.ask(f"{domain}.enable")
        self.go(address)

    def go(self, address: str) -> None:
        """Opens an address where a page is open already."""
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

    def asked(self) -> list[str]:
        """The addresses that were asked for."""
        asked = [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]
        return [address for address in asked if not address.startswith("data:")]

    def faults(self) -> list[dict]:
        """What the console says, and what could not be loaded."""
        wrong = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded", "Network.loadingFailed")
        return [event for event in self.events if event["method"] in wrong]


@pytest.fixture
def browser(tmp_path):
    """A browser of the test's own; without Chromium the test is skipped."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium")
    found = Browser(tmp_path / "profile")
    try:
        yield found
        found.close()
    finally:
        if found.process.poll() is None:
            found.process.kill()
            found.process.wait()
