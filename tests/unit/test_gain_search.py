"""The search for a matrix's best gain goes on beyond its scan, towards either end."""

from __future__ import annotations

from dataclasses import replace

import fake_results
import numpy as np
import pytest

from escape_hw.api.procedure import run
from escape_hw.calibration.loop import gain_search
from escape_hw.errors import CalibrationError


@pytest.mark.parametrize("top", [0.06, 0.15, 0.3, 0.9])
@pytest.mark.parametrize("limit", [0.2, 2.0])
def test_a_best_gain_at_the_edge_of_the_scan_is_none(monkeypatch, top, limit):
    """Whatever the scale of the matrix, the gain found is the loop's best within what was tried."""
    tried = []

    def loop(bench, matrix, grid, *, gain, **options):
        tried.append(gain)
        return replace(
            fake_results.loop(), gain=gain, stable=gain < limit, residual_rms_nm=50 + abs(np.log(gain / top)),
            strehl=None, partial=False,
        )  # fmt: skip
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    found, runs = run(gain_search.find_best_gain(None, fake_results.matrix(), None))
    assert len(runs) <= len(gain_search.GAIN_FRACTIONS) + 4
    assert min(tried) <= found <= max(tried)
    if top < limit:
        # Within the scan's finest step there, or the parabola's reach.
        assert abs(np.log(found / top)) < np.log(1.5)


def test_a_loop_that_closes_at_no_gain_says_so(monkeypatch):
    def loop(bench, matrix, grid, *, gain, **options):
        return replace(fake_results.loop(), gain=gain, stable=False, partial=False)
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    with pytest.raises(CalibrationError, match=r"none of the gains .*0\.05"):
        run(gain_search.find_best_gain(None, fake_results.matrix(), None))
