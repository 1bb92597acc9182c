"""The emulated stage turns the twin's beam: the driver's position is that of the beam on the sensor."""

from __future__ import annotations

import numpy as np
import pytest

import escape_hw
from escape_hw.runtime.session.system import System

#: A small pyramid without imperfections of its own, its modulator at the other end of a wire.
SMALL = (
    "sensor.n_sub=16",
    "sensor.pupils_px=[[11.0,12.0],[38.0,16.0],[11.0,32.0],[33.0,32.0]]",
    "devices.wfs.region=[296,232,48,48]",
    'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0",
    "devices.dm.pitch_m=2.7e-3",
    "basis.n_modes=20",
    "calibration.sprint_modes=20",
    "loop.dropped_modes=2",
    "twin.wfs.photons_per_frame=2.0e6",
    "twin.pyramid.centre_offsets_px=[[0.0,0.0],[0.0,0.0],[0.0,0.0],[0.0,0.0]]",
    "twin.pyramid.drift=0.0",
    "twin.pyramid.ellipse=0.2",
    "devices.modulator.mode=hardware",
    "devices.modulator.wire.kind=emulator",
    'devices.modulator.options={zeroed="1"}',
)


def points(bench: System) -> np.ndarray:
    """Position of the twin's beam on the pyramid, lambda/D."""
    return np.asarray(bench.wfs._bench.beam_path.points().points)


def test_the_beam_goes_where_the_stage_points():
    with escape_hw.open_system("razor-pywfs", set=SMALL) as bench:
        assert bench.simulated
        assert points(bench).tolist() == [[0.0, 0.0]], "parked"
        assert bench.wfs.settings.frame_rate_hz == pytest.approx(300.0)
        bench.find_sensor(frames=20)
        assert np.hypot(*points(bench).T) == pytest.approx(np.full(20, 3.0), rel=5e-3)
        # The camera is slaved to the true frequency.
        assert bench.wfs.settings.frame_rate_hz == pytest.approx(1 / (66 * 50e-6))
        assert bench.modulator is not None
        bench.modulator.park()
        assert points(bench).tolist() == [[0.0, 0.0]]


def test_an_uncorrected_stage_draws_the_ellipse_that_its_loops_make():
    keys = (*SMALL, 'devices.modulator.stage.correction_source="none"')
    with escape_hw.open_system("razor-pywfs", set=keys) as bench:
        bench.find_sensor(frames=5)
        x, y = points(bench).T
        assert np.sqrt(2 * np.mean(x**2)) == pytest.approx(3 * 0.97965, rel=5e-3)
        assert np.sqrt(2 * np.mean(y**2)) == pytest.approx(3 * 0.94537, rel=5e-3)


#: What differs between two runs then is the modulation alone.
QUIET = ("twin.vibration.amplitude_rad=[0.0,0.0]", "twin.wfs.photons_per_frame=2.0e7")


def test_a_calibration_runs_over_the_wire():
    twin = (*SMALL[:-4], "twin.pyramid.ellipse=0.0", "twin.pyramid.phase=0.0")
    found = []
    for keys in (SMALL, twin):
        with escape_hw.open_system("razor-pywfs", seed=4, set=[*keys, *QUIET]) as bench:
            found.append(bench.calibrate("push-pull", frames=3).matrix.data)
    assert found[0].shape == found[1].shape
    assert np.corrcoef(found[0].ravel(), found[1].ravel())[0, 1] > 0.9999
