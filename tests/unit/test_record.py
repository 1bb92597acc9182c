"""What a run records of its bench: a true registration only where the configuration's is applied."""

from __future__ import annotations

import pytest
from small_system import configuration

from escape_hw.bench import Bench
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.testing.reference_devices import RecordingMirror, SyntheticCamera
from escape_sim.devices.bench import SimBench
from escape_sim.devices.twins import SimMirror, SimWavefrontSensorCamera


def record_of(*, foreign_mirror: bool = False, foreign_camera: bool = False) -> BenchRecord:
    """The record of a simulated bench, on which devices may be of a foreign simulation."""
    config = configuration("twin.registration.shift_x=12.0")
    simulated = SimBench(config)
    mirror = RecordingMirror() if foreign_mirror else SimMirror("dm", simulated)
    camera = SyntheticCamera() if foreign_camera else SimWavefrontSensorCamera("wfs", simulated)
    with Bench(config, mirror, camera) as bench:
        return BenchRecord.from_bench(bench)


def test_the_injected_registration_of_the_twin_is_recorded() -> None:
    record = record_of()
    assert record.simulated
    assert record.applies_twin_section
    assert record.injected is not None
    assert record.injected.shift_x == 12.0


@pytest.mark.parametrize("foreign", ["foreign_mirror", "foreign_camera"])
def test_a_foreign_simulation_has_no_known_registration(foreign: str) -> None:
    record = record_of(**{foreign: True})
    assert record.simulated
    assert not record.applies_twin_section
    assert record.injected is None
    assert record.header_fields("calibrate")["injected"] is None
