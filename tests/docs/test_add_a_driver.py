"""The page for authors of drivers names all required hooks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import escape_hw.api.adaptive_secondary
import escape_hw.api.camera
import escape_hw.api.mirror
import escape_hw.api.modulator
import escape_hw.api.phase_screen

PAGE = (Path(__file__).parents[2] / "docs" / "devices" / "add-a-driver.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "kind",
    [
        escape_hw.api.mirror.DeformableMirror,
        escape_hw.api.adaptive_secondary.AdaptiveSecondary,
        escape_hw.api.camera.Camera,
        escape_hw.api.modulator.TipTiltModulator,
        escape_hw.api.phase_screen.PhaseScreen,
    ],
)
def test_the_hooks_to_fill_in_are_those_that_are_abstract(kind: type) -> None:
    (row,) = (line for line in PAGE.splitlines() if line.startswith("|") and f"`{kind.__name__}`" in line)
    required, optional = (set(re.findall(r"`(\w+)`", cell)) for cell in row.split("|")[3:5])
    assert required == set(kind.__abstractmethods__)
    assert not [hook for hook in optional if not callable(getattr(kind, hook, None))]
