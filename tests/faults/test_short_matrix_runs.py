"""Runs hardly long enough for a matrix: the frames themselves tell the registration better than its sums."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import PLANTED, small

from escape_hw.api.procedure import run
from escape_hw.calibration import escape as procedure
from escape_hw.calibration.docrime import docrime_run
from escape_hw.calibration.escape_few import fit_record
from escape_hw.calibration.sprint import fit_steps
from escape_hw.calibration.telemetry_sprint import independent_columns

#: Frames of a run with 30 modes, and how many runs.
FRAMES, RUNS = 90, 6


def test_the_frames_err_less_than_the_sums_of_a_matrix():
    by_frames, by_sums = np.empty((2, RUNS, 5))
    with small() as bench:
        for k in range(RUNS):
            found = bench.run(docrime_run(bench, frames=FRAMES, record=True))
            matrix, grid, solution = found.result.matrix, found.result.grid, found.solution
            frames = bench.run(fit_record(bench, found.record, matrix, grid, 6)).estimate
            columns = independent_columns(matrix, solution.gram, solution.variance)
            model = bench.model(grid)
            sums = run(fit_steps(columns, model, covariance=solution.covariance, learn=True)).estimate
            by_frames[k] = frames.registration.to_array() - PLANTED
            by_sums[k] = sums.registration.to_array() - PLANTED
    ratio = np.sqrt(np.square(by_frames).mean(axis=0) / np.square(by_sums).mean(axis=0))
    # The scalings are the model's own errors here. Measured: 0.72, 0.84, 0.58.
    assert ratio[:3].mean() < 0.9


@pytest.mark.parametrize(("frames", "fitted"), [(120, 1), (310, 0)])
def test_the_frames_are_fitted_up_to_ten_per_mode(monkeypatch, frames, fitted):
    asked, real = [], procedure.fit_record

    def watched(*args):
        asked.append(args)
        return real(*args)

    monkeypatch.setattr(procedure, "fit_record", watched)
    with small() as bench:
        result = bench.run(procedure.escape(bench, frames=frames))
    assert len(asked) == fitted
    assert result.measured is not None
    assert result.registration.converged
