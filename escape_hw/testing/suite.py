"""Selection and execution of the checks for a device, with or without pytest."""

from __future__ import annotations

import unittest
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from escape_hw.api.adaptive_secondary import AdaptiveSecondary
from escape_hw.api.camera import Camera
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.testing import adaptive_secondary, camera, mirror, modulator, phase_screen  # noqa: F401
from escape_hw.testing import device as any_device  # noqa: F401 - these modules declare the checks
from escape_hw.testing.checks import CHECKS, Check, Factory

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
    """Every check for the kind of a device, up to a level; those of the base classes come first."""
    return _checks_of(type(device) if isinstance(device, Device) else Device, max_level)


def _checks_of(kind: type, max_level: int = 3) -> list[Check]:
    declared = (one for base in reversed(kind.__mro__) for one in CHECKS.get(base, ()))
    return [one for one in declared if one.level <= max_level]


#: Checks of a kind of device up to a level: ``mirror_checks(max_level=3)``.
mirror_checks = partial(_checks_of, DeformableMirror)
secondary_checks = partial(_checks_of, AdaptiveSecondary)
camera_checks = partial(_checks_of, Camera)
modulator_checks = partial(_checks_of, TipTiltModulator)
screen_checks = partial(_checks_of, PhaseScreen)


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
