"""Invalid arguments are refused before anything moves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from small_bench import assert_flat

from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.acquisition.sensor_setup import find_sensor, measure_dark
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.loop.gain_search import find_best_gain
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.errors import (
    CalibrationError,
    CommandRejected,
    ConfigError,
    EscapeError,
    IncompatibleProduct,
    TooFewFrames,
)
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes


def refuse(bench, procedure, error: type[EscapeError], match: str) -> None:
    """The procedure raises before the mirror gets any command."""
    before = bench.dm.sent_count
    with pytest.raises(error, match=match) as caught:
        bench.run(procedure)
    assert type(caught.value) is error
    assert bench.dm.sent_count == before
    assert bench.screen.state.inserted
    assert not bench.screen.state.blocked


@pytest.mark.parametrize(
    "procedure", [docrime, escape, push_pull, find_sensor, measure_model_psf, measure_dark]
)
@pytest.mark.parametrize("frames", [0, -1])
def test_no_frames(shared, procedure, frames):
    refuse(shared, procedure(shared, frames=frames), ConfigError, f"frames is {frames}")
    assert shared.dark is None


@pytest.mark.parametrize("procedure", [docrime, escape, push_pull])
@pytest.mark.parametrize("poke", [0, 0.0, -0.1, 2, math.nan, math.inf])
def test_pokes_that_mean_nothing(shared, procedure, poke):
    refuse(shared, procedure(shared, poke=poke), ConfigError, "poke is")


@pytest.mark.parametrize("frames", [1, 50, 81])
def test_too_few_frames_say_how_many(shared, frames):
    refuse(shared, docrime(shared, frames=frames), TooFewFrames, f"{frames} frames .* at least 82 frames")
    matrix = escape(shared, frames=frames, estimator="matrix")
    refuse(shared, matrix, TooFewFrames, f"{frames} frames .* at least 82 frames")


@pytest.mark.parametrize("frames", [1, 12])
def test_too_few_frames_for_the_telemetry(shared, frames):
    refuse(shared, escape(shared, frames=frames), TooFewFrames, f"{frames} frames .* at least 13 frames")


def test_an_unknown_estimator(shared):
    refuse(shared, escape(shared, estimator="magic"), ConfigError, "'magic' is unknown; it is one of auto")


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"gain": 0}, ConfigError, "gain is 0"),
        ({"gain": -0.3}, ConfigError, "gain is -0.3"),
        ({"gain": 9}, ConfigError, "gain is 9 .* at most 2"),
        ({"gain": math.nan}, ConfigError, "gain is nan"),
        ({"gain": math.inf}, ConfigError, "gain is inf"),
        ({"leak": -0.1}, ConfigError, "leak -0.1"),
        ({"leak": 1.5}, ConfigError, "leak 1.5"),
        ({"leak": math.nan}, ConfigError, "leak nan"),
        ({"frames": 0}, ConfigError, "frames is 0"),
        ({"frames": 1e3}, ConfigError, r"frames is 1000\.0; it must be a whole number"),
        ({"frames": "300"}, ConfigError, "frames is '300'; it must be a whole number"),
        ({"frames": True}, ConfigError, "frames is True"),
        ({"dropped_modes": 30}, CalibrationError, "30 dropped modes of 30 leave none"),
        ({"dropped_modes": 99}, CalibrationError, "99 dropped modes"),
        ({"dropped_modes": -1}, CalibrationError, "-1 dropped modes"),
    ],
)
def test_loop_settings_that_mean_nothing(shared, good, options, error, match):
    refuse(shared, close_loop(shared, good.matrix, good.grid, **options), error, match)


def test_a_gain_that_means_nothing_in_the_search(shared, good):
    refuse(shared, find_best_gain(shared, good.matrix, good.grid, gains=(0.0, 0.3)), ConfigError, "gain is 0")


@pytest.mark.parametrize(
    ("value", "match"), [(np.nan, "not finite"), (np.inf, "not finite"), (0.0, "singular|does not see|zero")]
)
def test_a_matrix_that_cannot_be_inverted(shared, good, value, match):
    spoilt = replace(good.matrix, data=np.full_like(good.matrix.data, value))
    refuse(shared, close_loop(shared, spoilt, good.grid), CalibrationError, match)


def test_matrix_and_grid_that_do_not_belong_together(shared, good):
    other = np.zeros_like(good.grid.valid)
    other.flat[: good.grid.n_valid] = True
    grid = replace(good.grid, valid=other)
    refuse(shared, close_loop(shared, good.matrix, grid), IncompatibleProduct, "different sub-apertures")
    fewer = good.grid.valid.copy()
    fewer[tuple(np.argwhere(fewer)[0])] = False
    grid = replace(good.grid, valid=fewer, references_px=good.grid.references_px[1:])
    refuse(shared, close_loop(shared, good.matrix, grid), IncompatibleProduct, "slopes; this bench has")
    short = replace(good.matrix, m2c=good.matrix.m2c[:-1])
    refuse(shared, close_loop(shared, short, good.grid), IncompatibleProduct, "36 actuators")


def test_a_grid_of_another_camera_region(shared, good):
    moved = replace(good.grid, origin_px=(good.grid.origin_px[0] + 120, good.grid.origin_px[1]))
    refuse(shared, close_loop(shared, good.matrix, moved), IncompatibleProduct, "beyond the camera's region")


def test_a_dark_frame_of_another_region(bench, good):
    bench.dark = np.zeros((100, 100), np.float32)
    refuse(bench, close_loop(bench, good.matrix, good.grid), CalibrationError, "dark frame has shape")


def test_one_nan_in_a_command_keeps_the_last_shape(bench):
    shape = np.linspace(-0.1, 0.1, bench.dm.info.n_act)
    bench.dm.send(shape)
    for bad in (np.nan, np.inf, -np.inf):
        command = np.zeros_like(shape)
        command[7] = bad
        with pytest.raises(CommandRejected, match="actuator 7 is"):
            bench.dm.send(command)
        np.testing.assert_array_equal(bench.dm.shape, shape)
    assert bench.dm.rejected_count == 3
    bench.dm.flatten()
    assert_flat(bench)


def test_a_procedure_that_computes_nan_ends_flat(bench, good, monkeypatch):
    """A defect in a procedure's numbers stops it at the guard, and the mirror goes flat."""
    calls = iter(range(1000))

    class Broken:
        def __init__(self, *_: object) -> None:
            self.gain, self.residual = 0.3, np.zeros(good.matrix.n_modes)

        def __call__(self, slopes: np.ndarray) -> np.ndarray:
            return np.full(good.matrix.n_modes, np.nan if next(calls) > 40 else 1e-3)

    monkeypatch.setattr("escape_hw.calibration.loop.control.LeakyIntegrator", Broken)
    with pytest.raises(CommandRejected, match="is nan"):
        bench.run(close_loop(bench, good.matrix, good.grid, frames=200))
    assert bench.dm.sent_count > 40
    assert_flat(bench)


def test_nan_slopes_never_become_a_matrix(bench, good, monkeypatch):
    def broken(self: ShackHartmannSlopes, frame: np.ndarray) -> np.ndarray:
        self.flux[:] = 1e6
        return np.full(self.grid.n_slopes, np.nan, np.float32)

    monkeypatch.setattr(ShackHartmannSlopes, "__call__", broken)
    with pytest.raises(ValueError, match="slopes or pokes are not finite"):
        bench.run(docrime(bench, frames=300, grid=good.grid))
    assert_flat(bench)
