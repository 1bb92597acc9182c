"""Optical gains smoothed over the modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from escape_hw.api.gains import OpticalGains

#: Sizes tried of the trend's bends and of the modes' own departures, relative to the mean gain.
_BENDS = np.concatenate([[0.0], np.geomspace(1e-2, 30.0, 15)])
_SCATTERS = np.concatenate([[0.0], np.geomspace(1e-3, 0.5, 12)])
#: Fewest modes that a trend can be told from.
_LEAST = 6


def smoothed(
    value: NDArray[np.float64], sigma: NDArray[np.float64], common_sigma: float = 0.0
) -> OpticalGains:
    """Smooth gains over the order of the modes, as much as their errors ask for.

    ``g_m = trend(x_m) + departure_m + noise_m``: the trend a cubic smoothing spline in the modes'
    spatial frequency, ``x = sqrt(m)`` for modes in the order of a Karhunen-Loeve basis, which is a
    line plus an integrated Wiener process (Wahba 1983, J. R. Stat. Soc. B 45, 133); the departures
    independent. How much the trend bends and how large the departures are is decided by the
    restricted likelihood, with the noise as stated by the standard errors.

    Parameters
    ----------
    value, sigma
        Gain of every mode and its standard error ``(n_modes,)``; infinite where it was not measured.
    common_sigma
        Handed on.

    Raises
    ------
    ValueError
        No mode was measured, or an error is zero or negative.
    """
    usable = np.isfinite(value) & np.isfinite(sigma)
    if not usable.any() or not (sigma[usable] > 0).all():
        raise ValueError("smoothing needs gains with positive standard errors, finite for one mode at least")
    if np.count_nonzero(usable) < _LEAST:
        return _mean(value, sigma, usable, common_sigma)
    x = np.sqrt(np.arange(value.size) + 1.0)
    x = (x - x[0]) / (x[-1] - x[0])
    scale = abs(float(np.average(value[usable], weights=sigma[usable] ** -2.0)))
    kernel = _wiener(x) * scale**2
    data = _Data(x, value, sigma, usable)
    choices = [(b, s * scale) for b in _BENDS for s in _SCATTERS]
    bend, scatter = max(choices, key=lambda one: data.likelihood(kernel * one[0] ** 2, one[1]))
    trend, trend_sigma = data.posterior(kernel * bend**2, scatter, own=False)
    best, best_sigma = data.posterior(kernel * bend**2, scatter, own=True)
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, common_sigma)


def _mean(
    value: NDArray[np.float64], sigma: NDArray[np.float64], usable: NDArray[np.bool_], common_sigma: float
) -> OpticalGains:
    """Of too few modes: their mean as trend, and each mode's own value where it was measured."""
    weights = sigma[usable] ** -2.0
    trend = np.full(value.size, np.average(value[usable], weights=weights))
    trend_sigma = np.full(value.size, weights.sum() ** -0.5)
    best, best_sigma = np.where(usable, value, trend), np.where(usable, sigma, trend_sigma)
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, common_sigma)


def _wiener(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of an integrated Wiener process of unit strength at x in [0, 1]."""
    low, high = np.minimum(x[:, None], x), np.maximum(x[:, None], x)
    return np.asarray(low**2 * (3 * high - low) / 6)


@dataclass(frozen=True, slots=True)
class _Data:
    """The measured gains; a line through them is fitted without a prior."""

    x: NDArray[np.float64]
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    usable: NDArray[np.bool_]

    def likelihood(self, kernel: NDArray[np.float64], scatter: float) -> float:
        """Restricted log-likelihood of a trend's covariance and of departures of that size."""
        factor, line, normal, left, _ = self._solved(kernel, scatter)
        logarithm = 2 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(normal)[1]
        return -0.5 * float(logarithm + left @ cho_solve(factor, left))

    def posterior(
        self, kernel: NDArray[np.float64], scatter: float, *, own: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and standard error of the trend, or with ``own`` of the gains themselves."""
        factor, line, normal, left, coefficients = self._solved(kernel, scatter)
        prior = kernel + (scatter**2 * np.eye(self.x.size) if own else 0.0)
        towards = prior[:, self.usable]
        everywhere = np.stack([np.ones_like(self.x), self.x], axis=1)
        mean = everywhere @ coefficients + towards @ cho_solve(factor, left)
        # What the line's own error adds, seen beside the process (kriging with a drift).
        beside = everywhere - towards @ cho_solve(factor, line)
        covariance = prior - towards @ cho_solve(factor, towards.T)
        covariance += beside @ np.linalg.solve(normal, beside.T)
        return mean, np.sqrt(np.maximum(np.diag(covariance), 0))

    def _solved(
        self, kernel: NDArray[np.float64], scatter: float
    ) -> tuple[
        tuple[NDArray[np.float64], bool],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
        NDArray[np.float64],
    ]:
        """Factor of the data's covariance, line, its normal matrix, residuals, coefficients."""
        at = self.usable
        whole = kernel[np.ix_(at, at)] + np.diag(self.sigma[at] ** 2 + scatter**2)
        factor = cho_factor(whole, lower=True)
        line = np.stack([np.ones(int(at.sum())), self.x[at]], axis=1)
        normal = line.T @ cho_solve(factor, line)
        coefficients = np.linalg.solve(normal, line.T @ cho_solve(factor, self.value[at]))
        return factor, line, normal, self.value[at] - line @ coefficients, coefficients
