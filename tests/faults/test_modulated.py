"""Modulation on the small twin: the same matrix as DO-CRIME, from a sixth of the frames, and faults."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from small_bench import assert_flat, small

from escape_hw.calibration.push_pull.modulation import modulation_demodulation
from escape_hw.errors import Aborted, CalibrationError, ConfigError, TooFewFrames


def test_the_same_matrix_as_docrime(good):
    with small("twin.loss_probability=0.002") as bench:
        result = bench.run(modulation_demodulation(bench, grid=good.grid))
        assert_flat(bench)
    truth, found = good.matrix, result.matrix
    assert found.method == "modulated"
    error = found.data - truth.data
    gain = np.vdot(found.data, truth.data) / np.vdot(truth.data, truth.data)
    assert gain == pytest.approx(1.0, abs=0.02)
    assert 0.5 < np.mean(np.square(error) / (np.square(found.sigma) + np.square(truth.sigma))) < 2
    assert np.linalg.norm(error) < 0.08 * np.linalg.norm(truth.data)
    assert result.response.delay_frames == pytest.approx(good.run.result.response.delay_frames, abs=0.05)
    assert found.snr().min() > 3


def test_more_modes_than_lines_take_more_batches(bench):
    result = bench.run(modulation_demodulation(bench, frames=200))
    assert result.matrix.metrics["batches"] == 2
    assert result.matrix.n_modes == 30
    assert np.median(result.matrix.snr()) > 3
    assert_flat(bench)


def test_stopped_after_the_first_batch_it_keeps_that():
    stop = threading.Event()

    def watch(progress):
        if progress.stage == "modulation" and progress.fraction > 0.6:
            stop.set()

    # In real time, so that reports come often enough: the second batch takes half a second.
    with small("twin.loss_probability=0", "twin.paced=true") as bench:
        with pytest.raises(Aborted) as caught:
            bench.run(modulation_demodulation(bench, frames=200), observers=(watch,), abort=stop)
        assert_flat(bench)
    partial = caught.value.partial
    assert partial.partial
    assert 0 < partial.matrix.n_modes < 30


def test_a_mirror_that_does_not_move_is_reported():
    with small("devices.dm.stroke_m=1e-12") as bench:
        with pytest.raises(CalibrationError, match="does not respond"):
            bench.run(modulation_demodulation(bench, frames=200))
        assert_flat(bench)


def test_numbers_that_mean_nothing_move_nothing(bench):
    sent = bench.dm.sent_count
    wrong = ({"frames": 0}, ConfigError), ({"poke": 0.0}, ConfigError), ({"frames": 20}, TooFewFrames)
    for words, error in wrong:
        with pytest.raises(error):
            bench.run(modulation_demodulation(bench, **words))
    assert bench.dm.sent_count == sent
