"""Standard errors of the registration that hold where the model misses something."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.weighted import WeightedMatrix

#: What the synthetic model gets wrong in common over the whole pupil, in the units of the parameters:
#: rms over random plants on a twin with all imperfections, when noise no longer counts (docs/decisions).
FLOOR = np.array([0.03, 0.03, 0.0, 0.045, 0.018])


class Linearised(Protocol):
    """A least-squares problem about its solution."""

    @property
    def residual(self) -> NDArray[np.float64]:
        """What is left ``(n_slopes, n_modes)``, in standard errors."""
        ...

    def information(self) -> NDArray[np.float64]:
        """Information on gain, registration and whatever comes after them ``(n, n)``."""
        ...

    def efficient(self) -> NDArray[np.float64]:
        """Derivatives by the same parameters ``(n, n_slopes, n_modes)``, less what is not theirs."""
        ...


def _windows(valid: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How near rows and columns are to each other: 1, falling to 0 at half the larger side of ``valid``."""
    reach = max(valid.shape) / 2
    rows, columns = (np.arange(n, dtype=float) for n in valid.shape)
    down, right = (np.maximum(1 - np.abs(at[:, None] - at) / reach, 0.0) for at in (rows, columns))
    return down, right


def _gathered(valid: NDArray[np.bool_], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of scores ``(n, n_valid)`` over sub-apertures by nearness; along rows, then along columns."""
    down, right = _windows(valid)
    maps = np.zeros((len(scores), *valid.shape))
    maps[:, valid] = scores
    return np.asarray((down @ maps @ right)[:, valid])


def _nearness(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How near valid sub-apertures are to each other ``(n_valid, n_valid)``, 1 in one place."""
    down, right = _windows(valid)
    rows, columns = np.nonzero(valid)
    return np.asarray(down[np.ix_(rows, rows)] * right[np.ix_(columns, columns)])


def _expected(scores: NDArray[np.float64], correlation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of summed scores ``(n, n)`` that a correlation of the slopes' noise makes."""
    spread = np.matmul(correlation, scores).reshape(len(scores), -1)
    return np.asarray(scores.reshape(len(scores), -1) @ spread.T)


def _positive(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of a symmetric matrix with positive eigenvalues."""
    values, directions = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((directions * np.maximum(values, 0.0)) @ directions.T)


def sandwich(
    weighted: WeightedMatrix, system: Linearised, noise: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Sandwich covariance of the common parameters, in units of their own.

    The middle is the covariance of the scores. What the noise makes of them is told by its own
    covariance, where it is known: neighbouring sub-apertures err together. What the model misses has
    its own pattern over the pupil and is in their scatter, so products of scores count with a weight that
    falls linearly with the distance to zero at half the pupil (Bartlett's window, as in Newey & West 1987
    over time), and only what they show beyond the noise is added: the scores of a solution sum to
    nothing, so the window alone takes the noise for smaller than it is. Without a covariance the window is
    all there is, and beyond it the scatter of the scores from mode to mode, which shows what moved all slopes
    together while one mode was measured. What is common to the whole pupil no scatter can show; :data:`FLOOR`
    stands for it.

    Parameters
    ----------
    weighted
        The measured matrix.
    system
        The problem about its solution.
    noise
        Covariance of the slopes' noise ``(n_slopes, n_slopes)`` up to a factor, where it is known.
    """
    bread = np.linalg.inv(system.information())
    scores, valid = system.efficient(), weighted.valid
    each = scores * system.residual
    # Slopes along x and along y of one sub-aperture stand in one place.
    by_place = each.sum(axis=2).reshape(len(each), 2, -1).sum(axis=1)
    meat = by_place @ _gathered(valid, by_place).T
    power = weighted.noise(system.residual) ** 2
    if noise is None:
        by_mode = each.sum(axis=1)
        meat += by_mode @ by_mode.T
    else:
        # A slope that never moved has no noise to share.
        spread = np.where(np.diag(noise) > 0, np.sqrt(np.diag(noise)), np.inf)
        correlation = power * noise / np.outer(spread, spread)
        near = np.tile(_nearness(valid), (2, 2)) * correlation
        # What the scatter shows beyond the noise is the model's.
        meat = _expected(scores, correlation) + _positive(meat - _expected(scores, near))
    found = bread @ meat @ bread
    # Never better than the noise alone allows.
    scale = np.sqrt(np.maximum(power * np.diag(bread) / np.diag(found), 1.0))
    covariance = found * np.outer(scale, scale)
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(FLOOR)
    return np.asarray(covariance)
