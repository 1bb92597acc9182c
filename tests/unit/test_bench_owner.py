"""What the owner of the devices does and says when one of them fails."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from escape_hw.errors import DeviceError
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.state import EngineState, LoopParameters


class FailedDevice:
    """An open device that neither flattens nor closes."""

    is_open = True

    def __init__(self, name: str) -> None:
        self.name = name
        self.closed = 0

    def flatten(self) -> None:
        raise DeviceError(self.name, "no power")

    def close(self) -> None:
        self.closed += 1
        raise DeviceError(self.name, "unplugged")


@pytest.fixture
def owner() -> Any:
    dm, wfs = FailedDevice("dm"), FailedDevice("wfs")
    bench: Any = SimpleNamespace(config=None, dm=dm, wfs=wfs, devices=(dm, wfs))
    nothing: Any = None
    return BenchOwner(bench, EngineState(LoopParameters()), nothing, nothing, nothing)


def test_a_mirror_that_is_not_flat_and_a_device_that_does_not_close_are_logged(
    owner: Any, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR):
        owner.make_safe("wfs: gone", "Fix it.", "wfs")
    assert "the mirror could NOT be made flat: dm: no power" in caplog.text
    assert "wfs did not close cleanly: wfs: unplugged" in caplog.text


def test_the_failed_device_is_closed_whatever_the_reason_says(owner: Any) -> None:
    owner.make_safe("wfs: is not the device that failed", "Fix it.")
    assert owner.bench.wfs.closed == 0
    owner.make_safe("the loop was opened: no frame", "Fix it.", "wfs")
    assert owner.bench.wfs.closed == 1
    assert owner.state.snapshot.device_messages == {"wfs": "the loop was opened: no frame"}
