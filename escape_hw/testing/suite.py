"""Selection and execution of the checks for a device, with or without pytest."""

from __future__ import annotations

import unittest
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from escape_hw.api.adaptive_secondary import AdaptiveSecondary
from escape_hw.api.camera import Camera
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.testing.adaptive_secondary import secondary_checks
from escape_hw.testing.camera import camera_checks
from escape_hw.testing.checks import Check, Factory, checks_up_to
from escape_hw.testing.device import COMMON_CHECKS
from escape_hw.testing.mirror import mirror_checks
from escape_hw.testing.modulator import modulator_checks
from escape_hw.testing.phase_screen import screen_checks

if TYPE_CHECKING:
    import pytest


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Outcome of one check: ``passed``, ``failed`` or ``skipped``, with a message."""

    check: str
    level: int
    outcome: str
    message: str = ""


def checks_for(device: Device, max_level: int = 3) -> list[Check]:
    """Every check for the kind of a device, up to a level."""
    if isinstance(device, AdaptiveSecondary):
        return secondary_checks(max_level)
    if isinstance(device, DeformableMirror):
        return mirror_checks(max_level)
    if isinstance(device, Camera):
        return camera_checks(max_level)
    if isinstance(device, TipTiltModulator):
        return modulator_checks(max_level)
    if isinstance(device, PhaseScreen):
        return screen_checks(max_level)
    return checks_up_to(COMMON_CHECKS, max_level)


def run_checks(factory: Factory, max_level: int = 3) -> list[CheckResult]:
    """Run every check on a device, without pytest.

    Parameters
    ----------
    factory
        Creates a new device that is not open.
    max_level
        0 nothing moves, 1 tiny, 2 normal, 3 full range.

    Returns
    -------
    list of CheckResult
        In the order of execution; all checks are run.
    """
    return [_outcome(check, factory) for check in checks_for(factory(), max_level)]


def _outcome(check: Check, factory: Factory) -> CheckResult:
    try:
        check(factory)
    except unittest.SkipTest as reason:
        return CheckResult(check.__name__, check.level, "skipped", str(reason))
    except Exception as failure:
        failure_text = (
            str(failure) if isinstance(failure, AssertionError) else f"{type(failure).__name__}: {failure}"
        )
        return CheckResult(check.__name__, check.level, "failed", failure_text)
    return CheckResult(check.__name__, check.level, "passed")


def parametrize_device_checks(factories: Mapping[str, Factory], max_level: int = 3) -> pytest.MarkDecorator:
    """Parametrise a pytest function with every check of every device.

    Parameters
    ----------
    factories
        Name -> factory; each is called once during collection to determine the kind of device.
    max_level
        0 nothing moves, 1 tiny, 2 normal, 3 full range.

    Examples
    --------
    >>> @parametrize_device_checks({"my mirror": make_my_mirror})  # doctest: +SKIP
    ... def test_contract(factory, check):
    ...     check(factory)
    """
    import pytest

    return pytest.mark.parametrize(
        ("factory", "check"),
        [
            pytest.param(factory, check, id=f"{name}-{check.__name__.removeprefix('check_')}")
            for name, factory in factories.items()
            for check in checks_for(factory(), max_level)
        ],
    )
