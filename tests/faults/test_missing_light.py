"""No light, or a mirror outside the beam: an error, never a matrix of noise."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.acquisition.sensor_setup import find_sensor
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.loop.gain_search import find_best_gain
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.errors import CalibrationError

#: What finds the grid says the one, what knows it the other.
NO_SPOTS = (
    r"no spots on the wavefront sensor|no light above|single bright pixels|lit above"
    r"|that the light comes through the lenslets"
)
NO_LIGHT = r"^wfs: no light on most sub-apertures for 25 frames"
BLOCKED = {
    "find_sensor": (lambda bench, good: find_sensor(bench), NO_SPOTS),
    "push_pull": (lambda bench, good: push_pull(bench, frames=3), NO_SPOTS),
    "docrime": (lambda bench, good: docrime(bench, frames=400), NO_SPOTS),
    "docrime with few frames": (lambda bench, good: docrime(bench, frames=82), NO_SPOTS),
    "escape": (lambda bench, good: escape(bench, frames=400), NO_SPOTS),
    "push_pull on a grid": (
        lambda bench, good: push_pull(bench, frames=30, grid=good.grid),
        f"{NO_LIGHT}|does not respond to a test step",
    ),
    "docrime on a grid": (lambda bench, good: docrime(bench, frames=400, grid=good.grid), NO_LIGHT),
    "escape on a grid": (lambda bench, good: escape(bench, frames=400, grid=good.grid), NO_LIGHT),
    "closed_loop": (lambda bench, good: close_loop(bench, good.matrix, good.grid, frames=300), NO_LIGHT),
    "best_gain": (lambda bench, good: find_best_gain(bench, good.matrix, good.grid, frames=100), NO_LIGHT),
    "model PSF": (lambda bench, good: measure_model_psf(bench), r"^science: no light"),
}


@pytest.mark.parametrize("name", BLOCKED)
def test_a_blocked_beam(good, name):
    procedure, message = BLOCKED[name]
    with small() as bench:
        bench.screen.set(blocked=True)
        with pytest.raises(CalibrationError, match=message):
            bench.run(procedure(bench, good))
        assert_flat(bench)


@pytest.mark.parametrize("name", ["docrime on a grid", "closed_loop"])
def test_light_that_is_lost_in_the_middle(good, name):
    procedure, message = BLOCKED[name]
    with small() as bench:
        running = procedure(bench, good)
        next(running)
        bench.screen.set(blocked=True)
        with pytest.raises(CalibrationError, match=message):
            bench.run(running)
        assert_flat(bench)


def test_a_blink_of_the_light_is_survived(good):
    """The loop continues after a few dark frames."""
    with small() as bench:
        blinks = iter(range(10**6))
        take = bench.wfs._next_frame

        def blinking(timeout_s: float):
            bench.screen.set(blocked=100 <= next(blinks) < 110)
            return take(timeout_s)

        bench.wfs._next_frame = blinking
        result = bench.run(close_loop(bench, good.matrix, good.grid, frames=600))
        assert result.stable
        assert_flat(bench)


@pytest.mark.parametrize(
    ("photons", "match"), [(1e3, NO_SPOTS), (3e4, f"{NO_SPOTS}|does not respond to the mirror.* light")]
)
def test_hardly_any_light(photons, match):
    """Signal below the threshold: refused, not turned into a matrix."""
    with small(f"twin.wfs.photons_per_frame={photons}") as bench:
        with pytest.raises(CalibrationError, match=match):
            bench.run(docrime(bench, frames=300))
        assert_flat(bench)


@pytest.mark.parametrize("frames", [82, 600])
@pytest.mark.parametrize("whiten", [True, False])
def test_a_mirror_that_is_not_in_the_beam(frames, whiten):
    with small("devices.dm.stroke_m=1e-12") as bench:
        with pytest.raises(CalibrationError, match="does not respond to the mirror"):
            bench.run(docrime(bench, frames=frames, whiten=whiten))
        assert_flat(bench)


def test_a_mirror_that_is_not_in_the_beam_stops_the_other_methods_too():
    with small("devices.dm.stroke_m=1e-12") as bench:
        with pytest.raises(CalibrationError, match="does not respond to the mirror"):
            bench.run(escape(bench, frames=400))
        bench.screen.set(inserted=False)
        with pytest.raises(CalibrationError, match="does not respond to a test step"):
            bench.run(push_pull(bench, frames=3))
        assert_flat(bench)


@pytest.mark.slow
def test_a_faint_response_shows_in_its_errors():
    """Just seen, a matrix comes out with errors as large as itself, and a note."""
    with small("devices.dm.stroke_m=3e-8") as bench:
        result = bench.run(docrime(bench, frames=1500))
    snr = np.median(result.matrix.snr())
    assert snr < 3
    assert (snr < 1) == any("signal-to-noise ratio below 1" in note for note in result.notes)


@pytest.mark.slow
def test_the_full_bench_in_the_dark_and_without_response():
    from escape_hw.runtime.session.system import open_system

    with open_system("razor-shwfs") as bench:
        bench.screen.set(blocked=True)
        with pytest.raises(CalibrationError, match=NO_SPOTS):
            bench.run(docrime(bench, frames=300))
        assert_flat(bench)
    with open_system("razor-shwfs", set=["devices.dm.stroke_m=1e-12"]) as bench:
        with pytest.raises(CalibrationError, match="does not respond to the mirror"):
            bench.run(docrime(bench, frames=300))
        assert_flat(bench)
