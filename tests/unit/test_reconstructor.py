"""Reconstructors invert the retained modes and drop those with the most stroke."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.errors import CalibrationError
from escape_hw.pipeline.control.reconstructor import reconstructor


def matrix(n_slopes=60, n_modes=12, seed=0):
    return np.random.default_rng(seed).normal(size=(n_slopes, n_modes))


def with_singular_values(values, n_slopes=40, seed=1):
    rng = np.random.default_rng(seed)
    u = np.linalg.qr(rng.normal(size=(n_slopes, len(values))))[0]
    v = np.linalg.qr(rng.normal(size=(len(values), len(values))))[0]
    return u, np.asarray(values, float), v


def test_nothing_dropped_is_the_pseudo_inverse():
    d = matrix()
    r = reconstructor(d)
    assert r.dtype == np.float32
    assert r.flags.c_contiguous
    assert r == pytest.approx(np.linalg.pinv(d), abs=1e-6)


def test_scale_does_not_matter_when_nothing_is_dropped():
    # A least-squares solution of full rank is the same in every unit.
    d = matrix()
    scale = np.geomspace(0.01, 100, d.shape[1])
    assert reconstructor(d, scale=scale) == pytest.approx(np.linalg.pinv(d), abs=1e-6)


def test_fewer_slopes_than_modes_yield_the_minimum_norm_solution():
    d = matrix(8, 12)
    assert reconstructor(d) == pytest.approx(np.linalg.pinv(d), abs=1e-6)


@pytest.mark.parametrize("dropped", [1, 3, 5])
def test_the_weakest_singular_values_are_dropped(dropped):
    u, s, v = with_singular_values([9, 7, 5, 3, 2, 0.5])
    r = reconstructor((u * s) @ v.T, dropped_modes=dropped)
    kept = slice(0, 6 - dropped)
    assert r == pytest.approx((v[:, kept] / s[kept]) @ u[:, kept].T, abs=1e-6)
    assert np.linalg.matrix_rank(r, tol=1e-5) == 6 - dropped


def test_modes_with_the_least_slopes_per_stroke_are_dropped():
    # Orthogonal columns: each is its own eigenmode. The third gives most slopes per unit but takes
    # forty times the stroke; the fifth gives least per unit and hardly any stroke.
    u = np.linalg.qr(matrix())[0][:, :5]
    strength, stroke = np.array([3.0, 2.0, 8.0, 4.0, 1.0]), np.array([1.0, 1.0, 40.0, 1.0, 0.1])
    d = u * strength
    r = reconstructor(d, scale=stroke, dropped_modes=1)
    assert np.abs(r[2]).max() < 1e-6
    assert r @ d == pytest.approx(np.diag([1, 1, 0, 1, 1]), abs=1e-5)
    plain = reconstructor(d, dropped_modes=1)
    assert plain @ d == pytest.approx(np.diag([1, 1, 1, 1, 0]), abs=1e-5)


def test_dropping_never_takes_more_stroke():
    rng = np.random.default_rng(3)
    d, stroke = matrix(seed=4), np.geomspace(1, 30, 12)
    slopes = rng.normal(size=d.shape[0])
    used = [
        np.linalg.norm(stroke * (reconstructor(d, scale=stroke, dropped_modes=k) @ slopes)) for k in range(12)
    ]
    assert (np.diff(used) < 1e-9).all()


@pytest.mark.parametrize("dropped", [-1, 12, 20])
def test_dropping_all_is_an_error(dropped):
    with pytest.raises(CalibrationError, match="drop fewer"):
        reconstructor(matrix(), dropped_modes=dropped)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_matrix_that_is_not_finite_is_an_error(bad):
    d = matrix()
    d[3, 4] = bad
    with pytest.raises(CalibrationError, match="not finite"):
        reconstructor(d)


def test_an_unseen_mode_is_an_error_unless_dropped():
    d = matrix()
    d[:, 5] = 0
    with pytest.raises(CalibrationError, match="singular"):
        reconstructor(d)
    r = reconstructor(d, dropped_modes=1)
    assert np.abs(r[5]).max() < 1e-6
    with pytest.raises(CalibrationError, match="singular"):
        reconstructor(np.zeros((10, 3)))
