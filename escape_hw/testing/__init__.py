"""Contract suite: checks that every driver and twin must pass, usable with or without pytest.

Checks of one kind of device are in one module each. Tests of ESCAPE itself are in ``tests/``.
"""

from escape_hw.testing.checks import Check, Factory
from escape_hw.testing.faulty_devices import FaultyCamera, FaultyMirror
from escape_hw.testing.suite import (
    CheckResult,
    camera_checks,
    checks_for,
    mirror_checks,
    modulator_checks,
    parametrize_device_checks,
    run_checks,
    screen_checks,
    secondary_checks,
)  # fmt: skip

__all__ = [
    "Check", "CheckResult", "Factory", "FaultyCamera", "FaultyMirror", "camera_checks", "checks_for",
    "mirror_checks", "modulator_checks", "parametrize_device_checks", "run_checks", "screen_checks",
    "secondary_checks",
]  # fmt: skip
