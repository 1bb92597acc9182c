"""A matrix that was saved and read back is equivalent to the one in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import escape_hw
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.runtime.session.record import BenchRecord


@pytest.mark.slow
def test_registration_from_the_file_is_that_from_memory(tmp_path: Path) -> None:
    with escape_hw.open_system("razor-shwfs", seed=3) as bench:
        measured = bench.run(docrime(bench, frames=300))
        save_matrix(tmp_path / "im.fits", measured, BenchRecord.from_bench(bench).origin())
        stored = load_matrix(tmp_path / "im.fits", expect_system="razor-shwfs")
        here, there = (
            sprint(matrix, bench.model(grid), modes=30)
            for matrix, grid in ((measured.matrix, measured.grid), (stored.matrix, stored.grid))
        )
    np.testing.assert_allclose(there.registration.to_array(), here.registration.to_array(), rtol=1e-6)
    np.testing.assert_allclose(there.sigma, here.sigma, rtol=1e-6)
    assert there.gain.value == here.gain.value
