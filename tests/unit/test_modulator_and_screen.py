"""Modulators and phase screens: their checked methods."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from escape_hw.api.modulator import Modulation
from escape_hw.api.phase_screen import ScreenState
from escape_hw.errors import DeviceError, NotOpen, SettingRejected
from escape_hw.testing.reference_devices import IdealPhaseScreen, QuantisedModulator


def test_frequency_is_quantised_and_stated() -> None:
    with QuantisedModulator() as stage:
        reached = stage.modulate(Modulation(1e-5, 300.0))
        assert reached.frequency_hz == pytest.approx(1 / (67 * 50e-6))
        assert stage.modulation == reached
        assert stage.check(reached) == reached


@pytest.mark.parametrize(
    "change",
    [
        {"radius_rad": -1e-6},
        {"radius_rad": math.nan},
        {"radius_rad": math.inf},
        {"frequency_hz": 0.0},
        {"frequency_hz": math.nan},
        {"frequency_hz": math.inf},
        {"centre_rad": (math.nan, 0.0)},
        {"centre_rad": (0.0, math.inf)},
    ],
)
def test_modulation_that_means_nothing_never_reaches_the_driver(change: dict[str, Any]) -> None:
    class Driver(QuantisedModulator):
        def _check(self, want: Modulation) -> Modulation:
            raise AssertionError("the driver was asked")

    with Driver("tip-tilt") as stage, pytest.raises(SettingRejected, match="tip-tilt: "):
        stage.modulate(replace(Modulation(1e-5, 300.0), **change))


def test_a_stage_that_does_not_start_is_found_out() -> None:
    class Dead(QuantisedModulator):
        def _modulate(self, modulation: Modulation) -> None:
            """Do nothing, like a stage whose servo is off."""

    with Dead() as stage, pytest.raises(DeviceError, match="does not move"):
        stage.modulate(Modulation(1e-5, 300.0))


def test_parking_needs_an_open_stage() -> None:
    with pytest.raises(NotOpen):
        QuantisedModulator().park()


def test_a_stage_without_a_clock_of_its_own_is_parked_when_released() -> None:
    stage = QuantisedModulator()
    with pytest.raises(NotOpen):
        stage.release()
    stage.open().modulate(Modulation(1e-5, 300.0))
    assert not stage.release()
    assert not stage.is_open
    assert stage.status().modulation is None


def test_screen_keeps_what_is_not_given() -> None:
    with IdealPhaseScreen() as screen:
        assert screen.set(inserted=False) == ScreenState(1, False, 0.0135)
        assert screen.set(screen=3, speed_m_s=0.0) == ScreenState(3, False, 0.0)
        assert screen.set(blocked=True) == ScreenState(3, False, 0.0, True)
        assert screen.set() == screen.state


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"screen": 4}, r"screen 4 is not one of 0\.\.3"),
        ({"screen": -1}, r"0\.\.3"),
        ({"screen": 1.5}, "whole number"),
        ({"screen": True}, "whole number"),
        ({"inserted": 1}, "true or false"),
        ({"blocked": 1}, "true or false"),
        ({"speed_m_s": -0.1}, "not be negative|not negative"),
        ({"speed_m_s": math.inf}, "finite"),
        ({"speed_m_s": math.nan}, "finite"),
    ],
)
def test_screen_refuses_what_means_nothing(change: dict[str, Any], words: str) -> None:
    with IdealPhaseScreen("changer") as screen:
        before = screen.state
        with pytest.raises(SettingRejected, match=words):
            screen.set(**change)
        assert screen.state == before
