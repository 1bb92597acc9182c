"""The present bench of RAZOR, by the options documented for it: lenslets and registration."""

from __future__ import annotations

import shlex
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import escape_hw
from escape_hw.config.loader import load_system

SYSTEMS = Path(__file__).parents[2] / "docs" / "systems.md"
#: Few modes, for a short test.
FEW = ["basis.n_modes=30", "calibration.sprint_modes=30", "loop.dropped_modes=0"]


def documented_settings() -> list[str]:
    (line,) = (line for line in SYSTEMS.read_text().splitlines() if "416,416" in line)
    return [value for option, value in pairwise(shlex.split(line)) if option == "--set"]


def test_the_valid_lenslets_are_those_that_the_pupil_covers() -> None:
    valid = load_system("razor-shwfs", overrides=documented_settings()).sensor.valid_map()
    samples = (np.arange(24 * 20) + 0.5) / 20 - 12
    inside = np.hypot(samples, samples[:, None]) < 24.35 / 2
    covered = inside.reshape(24, 20, 24, 20).mean(axis=(1, 3))
    assert valid is not None
    assert valid.sum() == 452
    assert np.array_equal(valid, covered > 2 / 3)


@pytest.mark.slow
def test_the_injected_registration_is_found_with_452_lenslets() -> None:
    with escape_hw.open_system("razor-shwfs", seed=5, set=[*documented_settings(), *FEW]) as system:
        found = system.calibrate("escape", frames=600)
        assert system.dm.info.n_act == 97
        assert system.config.devices.wfs.region[2:] == (416, 416)
    assert found.grid.n_valid == 452
    assert found.registration is not None
    injected = system.config.twin.registration.to_registration()
    for name, one in found.registration.parameters().items():
        assert abs(one.value - getattr(injected, name)) < 4 * one.sigma, name
