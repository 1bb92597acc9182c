"""The page for authors of drivers names all required hooks."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

import escape_hw.api.adaptive_secondary
import escape_hw.api.camera
import escape_hw.api.mirror
import escape_hw.api.modulator
import escape_hw.api.phase_screen

PAGE = (Path(__file__).parents[2] / "docs" / "devices" / "add-a-driver.md").read_text(encoding="utf-8")


KINDS = (
    escape_hw.api.mirror.DeformableMirror,
    escape_hw.api.adaptive_secondary.AdaptiveSecondary,
    escape_hw.api.camera.Camera,
    escape_hw.api.modulator.TipTiltModulator,
    escape_hw.api.phase_screen.PhaseScreen,
)


@pytest.mark.parametrize("kind", KINDS)
def test_the_hooks_to_fill_in_are_those_that_are_abstract(kind: type) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith("|") and f"`{kind.__name__}`" in line)
    required, optional = (set(re.findall(r"`(\w+)`", cell)) for cell in row.split("|")[3:5])
    assert required == set(kind.__abstractmethods__)
    assert not [hook for hook in optional if not callable(getattr(kind, hook, None))]


@pytest.mark.parametrize("kind", KINDS)
def test_the_arguments_of_hooks_are_on_the_page(kind: type) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith("|") and f"`{kind.__name__}`" in line)
    arguments = {
        hook: (re.findall(r"^ *`(\w+)`", cells[1]), bool(cells[2].strip()))
        for cells in (line.split("|")[1:4] for line in PAGE.splitlines() if line.startswith("| `_"))
        for hook in re.findall(r"`(\w+)`", cells[0])
    }
    for hook in re.findall(r"`(_\w+)`", row):
        signature = inspect.signature(getattr(kind, hook))
        names, returns = arguments.get(hook, ([], False))
        assert [*signature.parameters][1:] == names, hook
        assert (signature.return_annotation != "None") == returns, hook
