"""Reports of runs with hostile names: no name becomes an element, a script or a reference of the page."""

from __future__ import annotations

import dataclasses
import json
import random
import subprocess
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import fake_results as fake
import pytest
from campaign_table import Campaign
from system_packages import find_browser

from escape_hw.errors import EscapeError
from escape_hw.io import documents
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.run_folder import RESULT_FILE, RunFolder
from escape_hw.report.run_report import write_report

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000)]

SEED, NUMBER = 80, 40
BROWSER = find_browser()
#: Elements that no page has by itself, and texts that leave their place in it.
PAYLOADS = (
    "<script>alert(1)</script>", "</title><script>alert(1)</script>", "</style><script>alert(1)</script>",
    "</text></svg><script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "' onmouseover='alert(1)",
    '" onload="alert(1)', "--><script>alert(1)</script>", "]]><script>alert(1)</script>",
    '<a href="javascript:alert(1)">x</a>', "<iframe src=//example.invalid>", "<svg onload=alert(1)>",
    "&lt;script&gt;", "&#60;script&#62;", "{{7*7}}", "${x}", "$\\alpha<b>$", "<base href=//example.invalid>",
    "<x-evil>", "\u202e<b>", "\x0b<b>", "<b", "a" * 3000 + "<i>",
)  # fmt: skip


class Elements(HTMLParser):
    """Collects the kinds of elements, and what a browser would run or load."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.active: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            outside = name.endswith(("src", "href")) and not (value or "").startswith(("#", "data:image/"))
            if name.startswith("on") or outside:
                self.active.append(f"{tag} {name}={value}"[:100])

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)


def elements(page: Path) -> Elements:
    found = Elements()
    found.feed(page.read_text(encoding="utf-8"))
    return found


#: Tells whether one of the payloads was run; stands before everything else in the page.
WITNESS = "<script>window.alert = () => document.documentElement.setAttribute('data-ran', 'yes')</script>"
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--virtual-time-budget=2000", "--dump-dom",
)  # fmt: skip


def runs_a_script(browser: str, page: str, folder: Path) -> bool:
    """Whether a browser runs one of the payloads of a page."""
    copy = folder / "page.html"
    copy.write_text(WITNESS + page, encoding="utf-8")
    words = [browser, *QUIET, f"--user-data-dir={folder / 'profile'}", copy.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert "window.alert" in done.stdout
    return 'data-ran="yes"' in done.stdout


def make_run(folder: Path, name: Callable[[str], str]) -> Path:
    """A run folder whose texts are passed through ``name``."""
    with RunFolder("razor-shwfs", "test", folder) as run:
        run.write_config(f"# {name('a comment')}\nschema = 1\n")
        matrix = dataclasses.replace(fake.calibration("escape", n=8, n_modes=6), notes=(name("a note"),))
        run.add_product(name("escape"), save_matrix(run.file("escape.fits"), matrix))
        loop = dataclasses.replace(fake.loop(), notes=(name("another note"),))
        system = name("razor-shwfs").encode("ascii", "replace").decode()[:20]
        run.add_product(name("loop"), save_loop(run.file("loop.fits"), loop, system, True))
        run.write_result(
            {
                **documents.header_fields("test", "razor-shwfs", True, 1),
                "title": "a title",
                "injected": fake.INJECTED.to_dict(),
                "labels": {"escape": {"label": "ESCAPE", "measured": "DO-CRIME", "column": "SHORT"}},
                "criteria": [{"text": "a met one", "met": True}],
            }
        )
    return run.path


def spoil(value: Any, name: Callable[[str], str]) -> Any:
    """Texts and keys of a document, passed through ``name``; paths of products stay."""
    match value:
        case dict():
            return {name(key): spoil(one, name) for key, one in value.items()}
        case list():
            return [spoil(one, name) for one in value]
        case str() if not value.endswith(".fits"):
            return name(value)
    return value


def hostile_pages(campaign: Campaign, folder: Path) -> Iterator[tuple[int, Path]]:
    """Reports of runs whose names are hostile, with their number; those that are refused are counted."""
    rng = random.Random(SEED)

    def sometimes(text: str, probability: float = 0.03) -> str:
        return rng.choice(PAYLOADS) if rng.random() < probability else text

    for number in range(NUMBER):
        run = make_run(folder / f"{number} <b>&'\"", lambda text: sometimes(text, 0.5))
        file = run / RESULT_FILE
        file.write_text(json.dumps(spoil(json.loads(file.read_text()), sometimes)))
        try:
            yield number, write_report(run)
        except EscapeError:
            campaign.count("refused")
        except Exception as error:
            campaign.fail(f"{number}: {type(error).__name__}: {str(error)[:300]}")


def test_reports(campaign: Campaign, tmp_path: Path) -> None:
    usual = elements(write_report(make_run(tmp_path / "usual", lambda text: text)))
    assert not usual.active
    assert "script" not in usual.tags
    for number, page in hostile_pages(campaign, tmp_path):
        found = elements(page)
        strange = found.tags - usual.tags
        if strange or found.active:
            campaign.fail(f"{number}: {sorted(strange)} {found.active}")
        else:
            campaign.count("harmless page")
    campaign.end("reports of runs with hostile names")


@pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed (apt install chromium)")
def test_reports_in_a_browser(campaign: Campaign, tmp_path: Path) -> None:
    assert BROWSER is not None
    assert runs_a_script(BROWSER, PAYLOADS[0], tmp_path)
    for number, page in hostile_pages(campaign, tmp_path):
        if runs_a_script(BROWSER, page.read_text(encoding="utf-8"), tmp_path):
            campaign.fail(f"{number}: a script ran")
        else:
            campaign.count("harmless page")
    campaign.end("reports of runs with hostile names, in Chromium")
