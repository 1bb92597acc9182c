"""Standard errors of the registration that hold where the model misses something."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.weighted import WeightedMatrix

#: What the synthetic model gets wrong in common over the whole pupil, in the units of the parameters:
#: rms over random plants on a twin with all imperfections, when noise no longer counts (docs/decisions).
_FLOOR = np.array([0.04, 0.04, 3e-4, 0.035, 0.018])


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


def sandwich(
    weighted: WeightedMatrix, system: Linearised, noise: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Sandwich covariance of the common parameters, in units of their own.

    The middle holds the noise's correlation between patches, where it is known, and else the
    scatter of the scores from mode to mode, which shows what moved all slopes together while one
    mode was measured. To it comes the scatter from patch to patch of 2 x 2 sub-apertures as it is
    found, which includes what the model still misses: neighbouring lenslets fall on the pixels in
    opposite ways, so that much of it cancels within a patch. What is common to the whole pupil no
    scatter can show; :data:`_FLOOR` stands for it.

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
    scores, patches = system.efficient(), weighted.patches
    each = scores * system.residual
    by_slope = each.sum(axis=2)
    by_patch = np.zeros((by_slope.shape[0], int(patches.max()) + 1))
    np.add.at(by_patch.T, patches, by_slope.T)
    meat = by_patch @ by_patch.T
    if noise is None:
        by_mode = each.sum(axis=1)
        meat += by_mode @ by_mode.T
    else:
        # Within a patch the scatter holds the noise already.
        apart = patches[:, None] != patches[None, :]
        whole = np.where(apart, noise / np.sqrt(np.outer(np.diag(noise), np.diag(noise))), 0.0)
        spread = np.matmul(whole, scores).reshape(len(scores), -1)
        # Only what adds to the errors counts: negative correlations are too uncertain to trade on.
        shares, directions = np.linalg.eigh(scores.reshape(len(scores), -1) @ spread.T)
        meat += (directions * np.maximum(shares, 0.0)) @ directions.T
    found = bread @ meat @ bread
    # Never better than the noise alone allows.
    scale = np.sqrt(np.maximum(np.diag(bread) / np.diag(found), 1.0))
    covariance = found * np.outer(scale, scale)
    covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(_FLOOR)
    if not weighted.measured:
        covariance = covariance * np.mean(np.square(system.residual))
    return np.asarray(covariance)
