"""A fault at each call of a sequence in turn: an error with a remedy, a closed device, a safe mirror."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from driver_bench import PARTS, fresh, make

from escape_hw.errors import DeviceError, DeviceLost


def use_mirror(dm: Any) -> None:
    with dm:
        dm.send(np.full(97, 0.15))
        dm.send(np.full(97, -0.15))
        dm.play_patterns(np.full((2, 97), -0.15))
        dm.flatten()


def use_camera(camera: Any) -> None:
    with camera:
        camera.next_frame(0.05)
        camera.next_frame(0.05)
        camera.configure(replace(camera.settings, exposure_s=1e-3))
        camera.next_frame(0.05)


USES: dict[str, Callable[[Any], None]] = {"alpao": use_mirror, "ximea": use_camera, "aravis": use_camera}
#: What may happen at a call, for each library as far as it means something there.
ACTIONS = {
    "alpao": ("error 0x104", "error 0x10D", "unacknowledged 0x10D", "ignore", "timeout 1", "reset", "unplug"),
    "ximea": (
        "error 13", "ignore", "timeout 1", "reset", "short 20", "short 40", "unplug 1", "unplug 55",
        "unplug 56",
    ),
    "aravis": ("error 3", "ignore", "timeout 1", "unplug"),
}  # fmt: skip


def failure(driver: str, device: Any) -> str | None:
    """Use a device; what its error says, if it failed."""
    try:
        USES[driver](device)
    except DeviceError as error:
        return str(error)
    return None


def first_use(driver: str, device: Any) -> None:
    if driver == "alpao":
        device.send(np.zeros(97))
    else:
        device.next_frame(0.5)


def length(driver: str) -> int:
    """Calls of an undisturbed session."""
    library = fresh(PARTS[driver][1])
    device = make(driver)
    USES[driver](device)
    assert not library.violations
    return library.n_calls


@pytest.mark.parametrize(
    ("driver", "action"), [(d, action) for d, actions in ACTIONS.items() for action in actions]
)
@pytest.mark.slow
def test_a_fault_at_each_call(driver: str, action: str) -> None:
    n_calls = length(driver)
    assert n_calls >= 10
    raised = 0
    for number in range(1, n_calls + 1):
        library = fresh(PARTS[driver][1], f"* {number} {action}")
        device = make(driver)
        said = failure(driver, device)
        raised += said is not None
        assert said is None or (said.startswith(device.name) and len(said) > 30), f"call {number}: {said}"
        assert not device.is_open, f"call {number}: still open"
        device.close()
        if action != "ignore":  # a library that lies about what it did cannot be used correctly
            assert not library.violations, f"call {number} of {library.calls}: {library.violations}"
        if driver == "alpao" and not action.startswith("unplug"):
            assert not library.shape(97).any(), f"call {number}: the mirror is not at zero"
        if driver == "aravis":
            assert library.library.escape_stand_in_leaks() == 0, f"call {number}: {library.calls}"
        library.clear()
        with device:
            assert device.is_open, f"call {number}: it cannot be opened again"
    assert raised or action in ("ignore", "timeout 1", "short 40")


@pytest.mark.parametrize(
    ("driver", "call"),
    [("alpao", "asdkSend"), ("ximea", "xiGetImage"), ("aravis", "arv_stream_timeout_pop_buffer")],
)
def test_an_unplugged_device_is_reported_with_a_remedy(driver: str, call: str) -> None:
    library = fresh(PARTS[driver][1])
    device = make(driver).open()
    library.script(f"{call} 1 unplug")
    with pytest.raises(DeviceLost, match=r"check (power, )?cable( and power)?") as lost:
        first_use(driver, device)
    assert "open" in str(lost.value)
    try:
        device.close()
    except DeviceLost:
        assert driver == "alpao", "nobody can flatten a mirror that has gone, and it says so"
    assert not device.is_open
    assert not library.violations
