"""Optical gains smoothed over the modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from escape_hw.api.gains import OpticalGains
from escape_hw.errors import CalibrationError

Pair = tuple[NDArray[np.float64], NDArray[np.float64]]

#: Sizes tried of the trend's bends and of the modes' own departures, relative to the mean gain; the
#: latter evenly spaced: a standard deviation's flat prior, which keeps small groups honest (Gelman 2006).
_BENDS = np.concatenate([[0.0], np.geomspace(1e-2, 30.0, 15)])
_SCATTERS = np.concatenate([np.arange(0.0, 0.1, 0.01), np.arange(0.1, 0.5, 0.1)])
#: Least probability, relative to the likeliest, at which a pair of sizes still counts.
_UNLIKELY = 1e-3
#: Fewest modes that a trend can be told from.
_LEAST = 6


def smoothed(
    value: NDArray[np.float64], sigma: NDArray[np.float64], common_sigma: float = 0.0
) -> OpticalGains:
    """Smooth gains over the order of the modes, as much as their errors ask for.

    ``g_m = trend(x_m) + departure_m + noise_m``: the trend a cubic smoothing spline in the modes'
    spatial frequency, ``x = sqrt(m)`` for modes in the order of a Karhunen-Loeve basis, which is a
    line plus an integrated Wiener process (Wahba 1983, J. R. Stat. Soc. B 45, 133); the departures
    independent. How much the trend bends and how large the departures are is weighed by the
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
    wiener = _wiener(x) * scale**2
    fits = [
        _Fit.of(x, value, sigma, usable, wiener * bend**2, scale * scatter)
        for bend in _BENDS
        for scatter in _SCATTERS
    ]
    likeliest = max(fit.logarithm for fit in fits)
    weighed = [(np.exp(fit.logarithm - likeliest), fit) for fit in fits]
    likely = [(weight, fit) for weight, fit in weighed if weight > _UNLIKELY]
    trend, trend_sigma = _averaged([(weight, fit.posterior(own=False)) for weight, fit in likely])
    best, best_sigma = _averaged([(weight, fit.posterior(own=True)) for weight, fit in likely])
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, common_sigma)


def usable(gains: OpticalGains) -> NDArray[np.float64]:
    """Gains to scale by: one mode's noise must not turn its sign, nor raise its gain many times."""
    least = 0.3 * float(np.median(gains.trend))
    if not least > 0:
        raise CalibrationError(
            "the optical gains are not positive: the loop works against the turbulence; "
            "measure the matrix again"
        )
    return np.maximum(gains.best, least)


def _averaged(parts: list[tuple[float, Pair]]) -> Pair:
    """Mean and standard error over weighted models, the models' disagreement in the error."""
    weights = np.array([weight for weight, _ in parts])[:, None]
    means, errors = (np.stack([pair[k] for _, pair in parts]) for k in (0, 1))
    mean = (weights * means).sum(axis=0) / weights.sum()
    variance = (weights * (errors**2 + (means - mean) ** 2)).sum(axis=0) / weights.sum()
    return mean, np.sqrt(variance)


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


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A line without a prior and a process with one, given the measured gains (kriging with a drift)."""

    everywhere: NDArray[np.float64]
    kernel: NDArray[np.float64]
    scatter: float
    usable: NDArray[np.bool_]
    factor: tuple[NDArray[np.float64], bool]
    normal: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    left: NDArray[np.float64]
    logarithm: float

    @classmethod
    def of(
        cls,
        x: NDArray[np.float64],
        value: NDArray[np.float64],
        sigma: NDArray[np.float64],
        usable: NDArray[np.bool_],
        kernel: NDArray[np.float64],
        scatter: float,
    ) -> _Fit:
        """The fit for a trend's covariance and departures of a size, with its restricted likelihood."""
        everywhere = np.stack([np.ones_like(x), x], axis=1)
        line = everywhere[usable]
        factor = cho_factor(
            kernel[np.ix_(usable, usable)] + np.diag(sigma[usable] ** 2 + scatter**2), lower=True
        )
        normal = line.T @ cho_solve(factor, line)
        coefficients = np.linalg.solve(normal, line.T @ cho_solve(factor, value[usable]))
        left = value[usable] - line @ coefficients
        logarithm = 2 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(normal)[1]
        logarithm = -0.5 * float(logarithm + left @ cho_solve(factor, left))
        return cls(everywhere, kernel, scatter, usable, factor, normal, coefficients, left, logarithm)

    def posterior(self, *, own: bool) -> Pair:
        """Mean and standard error of the trend, or with ``own`` of the gains themselves."""
        prior = self.kernel + (self.scatter**2 * np.eye(self.usable.size) if own else 0.0)
        towards = prior[:, self.usable]
        mean = self.everywhere @ self.coefficients + towards @ cho_solve(self.factor, self.left)
        # What the line's own error adds, seen beside the process.
        line = self.everywhere[self.usable]
        beside = self.everywhere - towards @ cho_solve(self.factor, line)
        covariance = prior - towards @ cho_solve(self.factor, towards.T)
        covariance += beside @ np.linalg.solve(self.normal, beside.T)
        return mean, np.sqrt(np.maximum(np.diag(covariance), 0))
