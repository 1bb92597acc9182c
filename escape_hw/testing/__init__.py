"""The contract suite: what every device must do, for the drivers here and anywhere else.

A check is a plain function that takes a factory of a fresh device, not open, and raises
``AssertionError`` when the contract is broken; ``check.level`` says how much it moves. Under
pytest::

    from escape_hw.testing import parametrize_device_checks

    @parametrize_device_checks({"my mirror": make_my_mirror})
    def test_contract(factory, check):
        check(factory)
"""

from escape_hw.testing.camera import camera_checks
from escape_hw.testing.checks import Check, Factory
from escape_hw.testing.faults import FaultyCamera, FaultyMirror
from escape_hw.testing.mirror import mirror_checks
from escape_hw.testing.modulator import modulator_checks
from escape_hw.testing.screen import screen_checks
from escape_hw.testing.secondary import secondary_checks
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
