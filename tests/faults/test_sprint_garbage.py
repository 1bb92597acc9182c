"""SPRINT on matrices of another system or of noise: an error, or not converged with a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.calibration.sprint.fit import sprint
from escape_hw.errors import CalibrationError, IncompatibleProduct


def on_maps(matrix, turn):
    """Every slope map turned or flipped on the grid, slopes left in their directions."""
    out, n = np.zeros_like(matrix.data), matrix.n_slopes // 2
    for half in (slice(0, n), slice(n, None)):
        for k in range(matrix.n_modes):
            image = np.zeros(matrix.valid.shape)
            image[matrix.valid] = matrix.data[half, k]
            out[half, k] = turn(image)[matrix.valid]
    return out


def split(data):
    n = len(data) // 2
    return data[:n], data[n:]


def flipped(matrix):
    """A camera read out from the other side: maps mirrored, x slopes reversed."""
    x, y = split(on_maps(matrix, np.fliplr))
    return np.concatenate([-x, y])


def transposed(matrix):
    """Rows and columns exchanged: maps transposed, x and y exchanged."""
    x, y = split(on_maps(matrix, np.transpose))
    return np.concatenate([y, x])


def shuffled(matrix, axis):
    order = np.random.default_rng(1).permutation(matrix.data.shape[axis])
    return np.take(matrix.data, order, axis=axis)


WRONG = {
    "pure noise": lambda m: np.random.default_rng(2).standard_normal(m.data.shape) * m.sigma,
    "strong noise": lambda m: np.random.default_rng(3).standard_normal(m.data.shape),
    "flipped": flipped,
    "flipped maps": lambda m: on_maps(m, np.fliplr),
    "upside down": lambda m: on_maps(m, np.flipud),
    "transposed": transposed,
    "transposed maps": lambda m: on_maps(m, np.transpose),
    "turned by 90 degrees": lambda m: on_maps(m, np.rot90),
    "turned by 180 degrees": lambda m: -on_maps(m, lambda image: np.rot90(image, 2)),
    "x and y exchanged": lambda m: np.concatenate(split(m.data)[::-1]),
    "x reversed": lambda m: np.concatenate([-split(m.data)[0], split(m.data)[1]]),
    "modes in another order": lambda m: shuffled(m, 1),
    "modes shifted by one": lambda m: np.roll(m.data, 1, axis=1),
    "slopes in another order": lambda m: shuffled(m, 0),
}


#: The likely ones; the others take as long again.
LIKELY = ("pure noise", "flipped")


@pytest.mark.parametrize(
    ("name", "errors"),
    [
        pytest.param(
            name, errors, marks=() if (name in LIKELY and errors == "measured") else pytest.mark.slow
        )
        for name in WRONG
        for errors in ("measured", "none")
    ],
)
def test_never_converged_and_wrong(good, name, errors):
    data = WRONG[name](good.matrix).astype(np.float32)
    sigma = good.matrix.sigma if errors == "measured" else np.zeros_like(good.matrix.sigma)
    spoilt = replace(good.matrix, data=data, sigma=sigma)
    try:
        estimate = sprint(spoilt, good.model, modes=10)
    except CalibrationError:
        return
    assert not estimate.converged
    assert estimate.warnings
    assert np.isfinite(estimate.registration.to_array()).all()


@pytest.mark.parametrize("errors", ["measured", "none"])
def test_the_good_matrix_itself_converges(good, errors):
    sigma = good.matrix.sigma if errors == "measured" else np.zeros_like(good.matrix.sigma)
    assert sprint(replace(good.matrix, sigma=sigma), good.model, modes=20).converged


@pytest.mark.parametrize(
    ("value", "where", "match"),
    [
        (0.0, ..., "is zero"),
        (np.nan, ..., "not finite"),
        (np.inf, ..., "not finite"),
        (np.nan, (5, 7), "not finite"),
        (-np.inf, (5, 7), "not finite"),
    ],
)
def test_zeros_and_infinities(good, value, where, match):
    data = good.matrix.data.copy()
    data[where] = value
    for sigma in (good.matrix.sigma, np.zeros_like(good.matrix.sigma)):
        with pytest.raises(CalibrationError, match=match):
            sprint(replace(good.matrix, data=data, sigma=sigma), good.model)


@pytest.mark.parametrize(("axis", "dead"), [("x", slice(None, 1)), ("y", slice(1, None))])
def test_one_half_of_the_slopes_dead(good, axis, dead):
    """It must not pass for a scaling."""
    halves = good.matrix.data.copy().reshape(2, good.grid.n_valid, -1)
    halves[dead] = 0
    data = halves.reshape(good.matrix.data.shape)
    for sigma in (good.matrix.sigma, np.zeros_like(good.matrix.sigma)):
        with pytest.raises(CalibrationError, match=f"all {axis} slopes are zero"):
            sprint(replace(good.matrix, data=data, sigma=sigma), good.model, modes=20)


def test_a_matrix_of_another_mirror_or_grid(good):
    with pytest.raises(IncompatibleProduct, match="36 actuators, the model has 37"):
        sprint(replace(good.matrix, m2c=good.matrix.m2c[:-1]), good.model)
    n, valid = good.matrix.n_slopes - 2, good.matrix.valid.copy()
    valid[tuple(np.argwhere(valid)[0])] = False
    fewer = replace(good.matrix, data=good.matrix.data[:n], sigma=good.matrix.sigma[:n], valid=valid)
    with pytest.raises(IncompatibleProduct, match=f"{n} slopes"):
        sprint(fewer, good.model)


@pytest.mark.parametrize("modes", [0, -3, np.array([], int), np.array([0, 30]), np.array([-1])])
def test_modes_that_are_not_there(good, modes):
    with pytest.raises(ValueError, match="modes"):
        sprint(good.matrix, good.model, modes=modes)


@pytest.mark.parametrize("rate", [0, -1, 1.5, float("nan")])
def test_learning_rates_that_mean_nothing(good, rate):
    with pytest.raises(ValueError, match="learning_rate is"):
        sprint(good.matrix, good.model, learning_rate=rate)
