"""Noise that moves many slopes together: the mirror's own shapes, on top of a level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Singular values of the mirror's shapes below which slopes do not show them, of the largest.
_UNSEEN = 1e-3
#: Slopes' worth of noise beyond the mirror's shapes, where a covariance has none.
_LEAST = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class NoisePatterns:
    """Correlation of the slopes' noise as patterns on top of a level, and so its inverse.

    What turbulence leaves after whitening is smooth over the pupil, so it looks like shapes of the mirror;
    beyond them a level is enough. The principal shapes of the mirror stand for the noise's own: their
    variances alone are told by few frames, where the inverse of a covariance of a thousand slopes takes
    many thousand, and the noise's own principal patterns nearly as many.

    Parameters
    ----------
    level
        Variance outside the patterns, of the slopes' own variances.
    patterns
        Orthonormal ``(n_slopes, n_patterns)``.
    variances
        Of the patterns ``(n_patterns,)``.
    """

    level: float
    patterns: NDArray[np.float64]
    variances: NDArray[np.float64]

    @classmethod
    def of(cls, covariance: NDArray[np.float64], zonal: NDArray[np.float64]) -> NoisePatterns:
        """The patterns of a measured covariance.

        Parameters
        ----------
        covariance
            Of the slopes' noise ``(n_slopes, n_slopes)``, up to a factor, from any number of frames.
        zonal
            What the mirror can make: slopes per unit command ``(n_slopes, n_act)``, in units of the slopes'
            noise.
        """
        spread = np.sqrt(np.diag(covariance))
        shapes, values, _ = np.linalg.svd(zonal, full_matrices=False)
        shapes = shapes[:, values > _UNSEEN * values[0]]
        correlation = covariance / np.outer(spread, spread)
        variances = (shapes * (correlation @ shapes)).sum(axis=0)
        n_slopes, n_patterns = shapes.shape
        # Each slope has a variance of 1.
        level = max(n_slopes - float(variances.sum()), _LEAST) / max(n_slopes - n_patterns, 1)
        return cls(level, shapes, np.maximum(variances, level))

    def inverse(self) -> NDArray[np.float64]:
        """The inverse of the correlation ``(n_slopes, n_slopes)``."""
        less = (1 / self.variances - 1 / self.level) * self.patterns
        return np.asarray(np.eye(len(self.patterns)) / self.level + less @ self.patterns.T)
