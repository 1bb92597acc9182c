"""Optical gains over the modes: a smoothing spline with independent departures, and Legendre curves."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from escape_hw.api.optical_gains import OpticalGains
from escape_hw.calibration.optical_gain.matrix_comparison import ValuesAndErrors
from escape_hw.errors import CalibrationError

#: Grids of the curvature of the trend and of the standard deviation of the departures, relative to the mean
#: gain; the latter evenly spaced, a flat prior of a standard deviation (Gelman 2006).
_TREND_SIZES = np.concatenate([[0.0], np.geomspace(1e-2, 30.0, 15)])
_DEPARTURE_SIZES = np.concatenate([np.arange(0.0, 0.1, 0.01), np.arange(0.1, 0.5, 0.1)])
#: Likelihood, relative to the largest, below which a pair of sizes is neglected.
_MIN_RELATIVE_LIKELIHOOD = 1e-3
#: Smallest number of modes for a trend.
_MIN_MODES = 6
#: Prior standard deviations of the Legendre coefficients 1 to 3, relative to the common gain.
COEFFICIENT_SIGMA = (0.3, 0.15, 0.08)


def smooth_over_modes(
    value: NDArray[np.float64], sigma: NDArray[np.float64], common_sigma: float = 0.0
) -> OpticalGains:
    """Smooth gains over the modes, according to their standard errors.

    The model is ``g_m = trend(x_m) + departure_m + noise_m``. The trend is a cubic smoothing spline in the
    spatial frequency of the modes, ``x = sqrt(m)`` in the order of a Karhunen-Loeve basis, that is, a line
    plus an integrated Wiener process (Wahba 1983, J. R. Stat. Soc. B 45, 133); the departures are
    independent. The result is an average over the sizes of curvature and departures, weighted by the
    restricted likelihood, with the noise given by the standard errors.

    ``value``, ``sigma``: gain of every mode and its standard error ``(n_modes,)``, infinite where it was not
    measured; ``common_sigma``: relative standard error common to all modes, copied to the result.

    Raises
    ------
    ValueError
        No mode was measured, or a standard error is not positive.
    """
    is_measured = np.isfinite(value) & np.isfinite(sigma)
    if not is_measured.any() or not (sigma[is_measured] > 0).all():
        raise ValueError("smoothing needs gains with positive standard errors, finite for one mode at least")
    if np.count_nonzero(is_measured) < _MIN_MODES:
        return _average_few_modes(value, sigma, is_measured, common_sigma)
    x = np.sqrt(np.arange(value.size) + 1.0)
    x = (x - x[0]) / (x[-1] - x[0])
    scale = abs(float(np.average(value[is_measured], weights=sigma[is_measured] ** -2.0)))
    wiener = _wiener_covariance(x) * scale**2
    fits = [
        _KrigingFit(x, value, sigma, is_measured, wiener * trend_size**2, scale * departure_size)
        for trend_size in _TREND_SIZES
        for departure_size in _DEPARTURE_SIZES
    ]
    largest_log_likelihood = max(fit.log_likelihood for fit in fits)
    weighted_fits = [(np.exp(fit.log_likelihood - largest_log_likelihood), fit) for fit in fits]
    likely_fits = [(weight, fit) for weight, fit in weighted_fits if weight > _MIN_RELATIVE_LIKELIHOOD]
    (trend, trend_sigma), (best, best_sigma) = (
        _model_average([(weight, fit.posterior(with_departures=which)) for weight, fit in likely_fits])
        for which in (False, True)
    )
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, common_sigma)


def clip_gains(gains: OpticalGains) -> NDArray[np.float64]:
    """Gains to scale a matrix by, not below 0.3 times the median trend.

    The noise of a mode must not change its sign or multiply its loop gain. Raises
    :class:`CalibrationError` if the median trend is not positive.
    """
    least = 0.3 * float(np.median(gains.trend))
    if not least > 0:
        raise CalibrationError(
            "the optical gains are not positive: the loop works against the turbulence; "
            "measure the matrix again"
        )
    return np.maximum(gains.best, least)


def _model_average(parts: list[tuple[float, ValuesAndErrors]]) -> ValuesAndErrors:
    """Mean and standard error over weighted models, including the scatter of the models."""
    weights = np.array([weight for weight, _ in parts])[:, None]
    means, errors = (np.stack([pair[k] for _, pair in parts]) for k in (0, 1))
    mean = (weights * means).sum(axis=0) / weights.sum()
    variance = (weights * (errors**2 + (means - mean) ** 2)).sum(axis=0) / weights.sum()
    return mean, np.sqrt(variance)


def _average_few_modes(
    value: NDArray[np.float64],
    sigma: NDArray[np.float64],
    is_measured: NDArray[np.bool_],
    common_sigma: float,
) -> OpticalGains:
    """For too few modes: the weighted mean as trend, and the value of each measured mode."""
    weights = sigma[is_measured] ** -2.0
    trend = np.full(value.size, np.average(value[is_measured], weights=weights))
    trend_sigma = np.full(value.size, weights.sum() ** -0.5)
    best, best_sigma = np.where(is_measured, value, trend), np.where(is_measured, sigma, trend_sigma)
    return OpticalGains(value, sigma, trend, trend_sigma, best, best_sigma, common_sigma)


def _wiener_covariance(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of an integrated Wiener process of unit strength at x in [0, 1]."""
    low, high = np.minimum(x[:, None], x), np.maximum(x[:, None], x)
    return np.asarray(low**2 * (3 * high - low) / 6)


class _KrigingFit:
    """Kriging with a linear drift: a line without prior plus a Gaussian process.

    For a covariance of the trend (``kernel``) and a size of the departures, with its restricted likelihood.
    """

    def __init__(
        self,
        x: NDArray[np.float64],
        value: NDArray[np.float64],
        sigma: NDArray[np.float64],
        is_measured: NDArray[np.bool_],
        kernel: NDArray[np.float64],
        departure_size: float,
    ) -> None:
        self.kernel, self.departure_size, self.is_measured = kernel, departure_size, is_measured
        self.drift_basis = np.stack([np.ones_like(x), x], axis=1)
        line = self.drift_basis[is_measured]
        noise = np.diag(sigma[is_measured] ** 2 + departure_size**2)
        self.factor = cho_factor(kernel[np.ix_(is_measured, is_measured)] + noise, lower=True)
        self.normal = line.T @ cho_solve(self.factor, line)
        self.coefficients = np.linalg.solve(self.normal, line.T @ cho_solve(self.factor, value[is_measured]))
        self.residual = value[is_measured] - line @ self.coefficients
        determinants = 2 * np.log(np.diag(self.factor[0])).sum() + np.linalg.slogdet(self.normal)[1]
        square = self.residual @ cho_solve(self.factor, self.residual)
        self.log_likelihood = -0.5 * float(determinants + square)

    def posterior(self, *, with_departures: bool) -> ValuesAndErrors:
        """Mean and standard error of the trend, or of the gains ``with_departures``."""
        prior = self.kernel + (
            self.departure_size**2 * np.eye(self.is_measured.size) if with_departures else 0.0
        )
        cross_covariance = prior[:, self.is_measured]
        mean = self.drift_basis @ self.coefficients + cross_covariance @ cho_solve(self.factor, self.residual)
        # Contribution of the error of the line, given the process.
        line = self.drift_basis[self.is_measured]
        drift_residual = self.drift_basis - cross_covariance @ cho_solve(self.factor, line)
        covariance = prior - cross_covariance @ cho_solve(self.factor, cross_covariance.T)
        covariance += drift_residual @ np.linalg.solve(self.normal, drift_residual.T)
        return mean, np.sqrt(np.maximum(np.diag(covariance), 0))


def gain_curve_basis(n_modes: int, coefficients: int = len(COEFFICIENT_SIGMA)) -> NDArray[np.float64]:
    """Legendre curves over the modes, one prior standard deviation each ``(coefficients, n_modes)``.

    The modes are in the order of a Karhunen-Loeve basis; there are at most as many curves as in
    :data:`COEFFICIENT_SIGMA`.
    """
    x = np.sqrt(np.arange(1, n_modes + 1))
    x = (2 * x - x[0] - x[-1]) / max(x[-1] - x[0], 1.0)
    each = np.diag((0.0, *COEFFICIENT_SIGMA))[1 : coefficients + 1]
    return np.stack([legendre.legval(x, one) for one in each]) if coefficients else np.zeros((0, n_modes))


def compute_command_curves(m2c: NDArray[np.float64], basis: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Change of a command due to each gain curve of a ``basis``, as matrices ``(n_act, n_act)``."""
    to_modes = np.linalg.pinv(m2c)
    return [(m2c * curve) @ to_modes for curve in basis]
