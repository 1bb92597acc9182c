"""Contract suite: checks that every driver and twin must pass, usable with or without pytest.

Checks of one kind of device are in one module each. Tests of ESCAPE itself are in ``tests/``.
"""

from escape_hw.testing.adaptive_secondary import secondary_checks
from escape_hw.testing.camera import camera_checks
from escape_hw.testing.checks import Check, Factory
from escape_hw.testing.faulty_devices import FaultyCamera, FaultyMirror
from escape_hw.testing.mirror import mirror_checks
from escape_hw.testing.modulator import modulator_checks
from escape_hw.testing.phase_screen import screen_checks
from escape_hw.testing.suite import CheckResult, checks_for, parametrize_device_checks, run_checks

__all__ = [
    "Check",
    "CheckResult",
    "Factory",
    "FaultyCamera",
    "FaultyMirror",
    "camera_checks",
    "checks_for",
    "mirror_checks",
    "modulator_checks",
    "parametrize_device_checks",
    "run_checks",
    "screen_checks",
    "secondary_checks",
]
