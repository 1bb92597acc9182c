"""Progress on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from escape_hw.api.procedure import Progress
from escape_hw.runtime.display.progress import ProgressView, format_time_left


def shown(terminal: bool, quiet: bool = False) -> str:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=120)
    with ProgressView(console, quiet) as view:
        for stage in ("push-pull", "DO-CRIME"):
            for done in (1, 50, 100):
                view(Progress(stage, done, 100, elapsed_s=done * 0.9, metrics={"rms": 0.123456}))
    return stream.getvalue()


def test_bars_show_stage_counts_and_time_left():
    text = shown(terminal=True)
    for word in ("push-pull", "DO-CRIME", "100/100", "frames", "done", "rms 0.123"):
        assert word in text


def test_lines_elsewhere_are_few():
    lines = shown(terminal=False).splitlines()
    assert lines == ["push-pull: 1 of 100 frames", "DO-CRIME: 1 of 100 frames"]


def test_lines_show_the_remaining_time_once_it_is_known():
    stream = io.StringIO()
    with ProgressView(Console(file=stream, width=120)) as view:
        view(Progress("DO-CRIME", 2, 200, elapsed_s=0.9))
    assert stream.getvalue() == "DO-CRIME: 2 of 200 frames, 1 min 29 s left\n"


def test_quiet_shows_nothing():
    assert shown(terminal=True, quiet=True) == ""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "0 s left"),
        (59.4, "59 s left"),
        (61, "1 min 01 s left"),
        (3660, "1 h 01 min left"),
        (float("nan"), ""),
        (float("inf"), ""),
        (-1, ""),
    ],
)
def test_time_left_as_text(seconds, words):
    assert format_time_left(seconds) == words


class Output:
    """An output of a notebook, as IPython shows it."""

    def __init__(self) -> None:
        self.html: list[str] = []

    def HTML(self, text: str) -> str:
        return text

    def display(self, html: str, display_id: bool) -> Output:
        assert display_id
        self.update(html)
        return self

    def update(self, html: str) -> None:
        self.html.append(html)


def test_a_notebook_shows_one_output_without_widgets(monkeypatch: pytest.MonkeyPatch) -> None:
    output = Output()
    monkeypatch.setitem(sys.modules, "IPython.display", output)
    with ProgressView(Console(file=io.StringIO(), force_jupyter=True)) as view:
        view(Progress("starting", 0, 0))
        for stage in ("DO-CRIME", "<SPRINT>"):
            for done in range(1, 100):
                view(Progress(stage, done, 100, elapsed_s=done * 0.9, metrics={"rms": 0.123456}))
    # In each stage few of the hundred are drawn.
    assert len(output.html) < 50
    assert "&lt;SPRINT&gt;: 1 of 100 frames  rms 0.123" in "".join(output.html)
    # In the end both stages are whole, and what was only waiting is gone.
    assert output.html[-1].count("value='100' max='100'") == 2
    assert "starting" not in output.html[-1]
