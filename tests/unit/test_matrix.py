"""Interaction matrices: consistent by construction, with noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix

VALID = np.array([[False, True, True], [True, True, True]])
N_SLOPES, N_MODES, N_ACT = 10, 3, 7


def matrix(**changes: Any) -> InteractionMatrix:
    parts: dict[str, Any] = {
        "data": np.arange(N_SLOPES * N_MODES, dtype=np.float32).reshape(N_SLOPES, N_MODES),
        "sigma": np.zeros((N_SLOPES, N_MODES), dtype=np.float32),
        "m2c": np.zeros((N_ACT, N_MODES)),
        "valid": VALID,
        "system": "test",
        "method": "push-pull",
        "simulated": True,
    }
    return InteractionMatrix(**(parts | changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"data": np.zeros(N_SLOPES, dtype=np.float32)}, r"\(n_slopes, n_modes\)"),
        ({"sigma": np.zeros((N_SLOPES, 2), dtype=np.float32)}, "sigma has shape"),
        ({"m2c": np.zeros((N_ACT, 2))}, "3 columns are needed"),
        ({"m2c": np.zeros(N_ACT)}, "3 columns are needed"),
        ({"valid": np.ones((2, 3), dtype=bool)}, "10 slopes do not fit 6 valid sub-apertures"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        matrix(**changes)


def test_sizes() -> None:
    assert (matrix().n_slopes, matrix().n_modes) == (N_SLOPES, N_MODES)


def test_maps_put_slopes_where_the_sub_apertures_are() -> None:
    x, y = matrix().maps(1)
    np.testing.assert_array_equal(x, [[np.nan, 1.0, 4.0], [7.0, 10.0, 13.0]])
    np.testing.assert_array_equal(y, [[np.nan, 16.0, 19.0], [22.0, 25.0, 28.0]])


def test_snr_is_that_of_signal_over_noise() -> None:
    rng = np.random.default_rng(3)
    valid = np.ones((50, 50), dtype=bool)
    noise = 0.5 * rng.standard_normal((5000, 2))
    signal = np.stack([rng.standard_normal(5000), np.zeros(5000)], axis=1)
    measured = matrix(
        data=(2.0 * signal + noise).astype(np.float32),
        sigma=np.full((5000, 2), 0.5, dtype=np.float32),
        m2c=np.zeros((N_ACT, 2)),
        valid=valid,
    )
    snr = measured.snr()
    assert snr[0] == pytest.approx(4.0, rel=0.05)
    assert snr[1] < 0.3


def test_snr_is_infinite_without_stated_errors() -> None:
    assert np.isinf(matrix().snr()).all()
