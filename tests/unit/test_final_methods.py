"""Final methods of devices cannot be replaced by a class, and the guard shares no memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from escape_hw.api.adaptive_secondary import AdaptiveSecondary
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.testing.reference_devices import IdealSecondary, RecordingMirror, SyntheticCamera

FINAL = [
    (RecordingMirror, DeformableMirror, ("send", "check", "flatten", "set_flat", "open", "close")),
    (IdealSecondary, AdaptiveSecondary, ("_send", "go_to", "recover")),
    (SyntheticCamera, Device, ("open", "close")),
]


@pytest.mark.parametrize(
    ("base", "name"), [(base, name) for base, _, names in FINAL for name in names], ids=str
)
def test_a_class_that_replaces_a_final_method_is_refused(base: type[Device], name: str) -> None:
    with pytest.raises(TypeError, match=rf"Driver\.{name} replaces a final method"):
        type("Driver", (base,), {name: lambda self, *values: None})


def test_a_mix_in_that_replaces_a_final_method_is_refused() -> None:
    class Unguarded:
        def send(self, command: Any) -> None: ...

    with pytest.raises(TypeError, match=r"Driver\.send replaces a final method of DeformableMirror"):
        type("Driver", (Unguarded, RecordingMirror), {})


def test_hooks_may_be_replaced() -> None:
    type("Driver", (RecordingMirror,), {"_send": lambda self, command: None})


@pytest.mark.parametrize("holder", ["report", "driver", "callback"])
def test_nobody_changes_the_memory_of_the_guard(holder: str) -> None:
    held: list[np.ndarray] = []

    class Keeps(RecordingMirror):
        def _send(self, command: np.ndarray) -> None:
            super()._send(command)
            held.append(command)

    with Keeps() as dm:
        if holder == "callback":
            dm.callback = held.append
        report = dm.send(np.full(21, 0.1))
        array = report.sent if holder == "report" else held[-1]
        array.setflags(write=True)
        array[:] = 0.9
        assert np.array_equal(dm.shape, np.full(21, 0.1))
