"""The documentation: it builds without a warning, and every page opens without an error, a network or a dead link."""

from __future__ import annotations

import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    pytest.importorskip("sphinx")
    folder = tmp_path_factory.mktemp("docs")
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", "docs", str(folder / "html")]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return folder / "html"


class Page(HTMLParser):
    """Collects the names of a page's places, and the addresses that it leads to or loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.places, self.links, self.loaded = set(), [], []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.places |= {found[key] for key in ("id", "name") if found.get(key)}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"])
        elif found.get("src") or (tag == "link" and found.get("href")):
            self.loaded.append(found.get("src") or found["href"])


def pages_of(built: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in sorted(built.rglob("*.html"))}


def test_every_local_link_leads_to_a_page_and_a_place_on_it(built):
    pages = pages_of(built)
    assert len(pages) > 20
    dead = []
    for path, page in pages.items():
        for address in {*page.links, *page.loaded}:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                if address in page.loaded:
                    dead.append((path.name, address, "is on another host"))
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                dead.append((path.name, address, "is not there"))
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                dead.append((path.name, address, "has no such place"))
    assert dead == []


def test_every_page_is_quiet_in_a_browser_and_asks_no_host(built, browser):
    browser.open("about:blank")
    wrong = []
    for path in sorted(built.rglob("*.html")):
        browser.events.clear()
        browser.go(path.as_uri())
        # pictures outside of the window are loaded too, and one that cannot be drawn is named
        pictures = browser.evaluate(
            "Promise.all([...document.images].map((picture) => { picture.loading = 'eager';"
            " return picture.decode().then(() => null, () => picture.src) })).then((found) => found.filter(Boolean))"
        )
        foreign = [address for address in browser.asked() if not address.startswith("file:")]
        flat = browser.evaluate(
            "[...document.querySelectorAll('math')].filter((m) => !m.getClientRects().length).length"
        )
        if pictures or foreign or flat or browser.faults():
            wrong.append((path.name, pictures, foreign, flat, browser.faults()))
    assert wrong == []


def test_equations_are_drawn_and_no_page_is_wider_than_a_telephone(built, browser):
    browser.open((built / "concepts.html").as_uri())
    assert browser.evaluate("document.querySelectorAll('math').length") >= 10
    assert "\\frac" not in browser.evaluate("document.body.innerText")
    wide = []
    for path in sorted(built.glob("*.html")):
        browser.events.clear()
        browser.ask("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=True)
        browser.go(path.as_uri())
        if not browser.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"):
            wide.append(path.name)
    assert wide == []
