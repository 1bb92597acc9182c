"""Every check fails on a device that violates only the checked rule."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import broken_cameras
import broken_devices
import broken_mirrors
import broken_secondaries
import broken_stages
import pytest
from broken import broken_class

from escape_hw.api.camera import Camera
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.testing import mirror_checks, secondary_checks
from escape_hw.testing.checks import CHECKS

#: Broken devices, and the checks that must be tested with them.
KINDS = {
    "cameras": (broken_cameras.BROKEN, CHECKS[Camera]),
    "devices": (broken_devices.BROKEN, CHECKS[Device]),
    "mirrors": (broken_mirrors.BROKEN, CHECKS[DeformableMirror]),
    "secondaries": (broken_secondaries.BROKEN, set(secondary_checks()) - set(mirror_checks())),
    "stages": (broken_stages.BROKEN, CHECKS[TipTiltModulator] + CHECKS[PhaseScreen]),
}


@pytest.mark.parametrize(
    ("base", "expected", "defects"),
    [pytest.param(*case[1:], id=case[0]) for broken, _ in KINDS.values() for case in broken],
)
def test_check_catches(
    catches: Callable[[Callable[[], Device], str], None],
    base: type[Device],
    expected: str,
    defects: dict[str, Any],
) -> None:
    catches(broken_class(base, defects), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_every_check_is_tested(kind: str) -> None:
    broken, checks = KINDS[kind]
    assert {check.__name__ for check in checks} == {f"check_{case[2]}" for case in broken}
