"""Whether a solution of SPRINT may be used: what does not fit, and where.

A fit counts as converged when its steps ended, the fitted matrix is significant, the registration is within
what the search covers, the data constrain every parameter, and the model explains the matrix to within its
noise and a small misfit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.coarse_search import MIN_EXPLAINED_FRACTION
from escape_hw.calibration.sprint.diagnostics import check_orientation
from escape_hw.calibration.sprint.tip_tilt import remove_tip_tilt
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Largest rms of the residual beyond the noise, relative to that of the matrix. A tenth is what the best
#: known description of a real mirror leaves; beyond it scalings and rotation are those of a wrong model.
_MAX_MISFIT = 0.15
#: The same from which on a note tells that the model does not fit to within the noise.
_NOTABLE_MISFIT = 0.02
#: Excess of the sum of squares, in its standard deviations for independent noise, that counts as a misfit.
_SIGNIFICANT = 10.0
#: Norm of the fitted matrix in standard errors below which the sensor does not see the mirror: the largest of
#: some hundred starts of a search in pure noise reaches about 5.
_MIN_SIGNIFICANCE = 10.0
#: One pattern of slopes with a larger fraction of the matrix is not the response to so many modes or more.
_MAX_PATTERN, _MIN_MODES = 0.5, 5
#: Largest scaling in % and rotation in degrees: the search covers half of them.
_MAX_SCALING, _MAX_ROTATION = 20.0, 30.0
#: A sub-aperture or actuator whose rms residual exceeds the median one by this factor is named, so many at
#: most.
_OUTLIER, _MAX_NAMED = 3.0, 12


def misfit_fraction(weighted: WeightedMatrix, residual: NDArray[np.float64]) -> float:
    """Rms of the residual beyond the noise, relative to that of the matrix; 0 where it is not significant.

    The mean of the residual over a column is left out: vibration during its measurement shifts all slopes
    alike.

    Parameters
    ----------
    weighted
        The matrix in units of its standard errors; without them all of the residual is misfit.
    residual
        Data minus model ``(n_slopes, n_modes)`` in the same units.
    """
    n = residual.size if weighted.has_standard_errors else 0
    excess = float(np.square(remove_tip_tilt(residual)).sum()) - n
    signal = float(np.square(weighted.data).sum()) - n
    if excess <= _SIGNIFICANT * np.sqrt(2.0 * n) or signal <= 0:
        return 0.0
    return float(np.sqrt(excess / signal))


def strongest_pattern_fraction(data: NDArray[np.float64]) -> float:
    """Fraction of a matrix's sum of squares that is one pattern of slopes times a number per column."""
    powers = np.linalg.eigvalsh(data.T @ data)
    return float(powers[-1] / powers.sum())


def describe_misfit(weighted: WeightedMatrix, residual: NDArray[np.float64]) -> tuple[str, ...]:
    """A note that the model does not fit to within the noise; empty if it does.

    Parameters
    ----------
    weighted, residual
        As for :func:`misfit_fraction`. Without standard errors the residual may be noise, and none is given.
    """
    misfit = misfit_fraction(weighted, residual) if weighted.has_standard_errors else 0.0
    if not _NOTABLE_MISFIT < misfit <= _MAX_MISFIT:
        return ()
    return (
        f"the model does not fit to within the noise: {misfit:.0%} of the matrix remain beyond it (reduced "
        f"chi-squared {np.mean(np.square(residual)):.3g}), which the standard errors include as far as "
        "leaving out parts of the matrix shows it",
    )


def describe_outliers(weighted: WeightedMatrix, residual: NDArray[np.float64]) -> str:
    """Name the sub-apertures and actuators with outlying residuals; empty if there are none."""
    by_sub_aperture = np.square(residual).sum(axis=1).reshape(2, -1).sum(axis=0)
    modes = weighted.modes
    commanded = residual @ np.linalg.pinv(modes)
    by_actuator = np.square(commanded).sum(axis=0)
    rows, columns = np.nonzero(weighted.valid)
    places = [f"({row}, {column})" for row, column in zip(rows, columns, strict=True)]
    parts = []
    for kind, power, names in (
        ("sub-apertures (row, column)", by_sub_aperture, places),
        ("actuators", by_actuator, [str(a) for a in range(len(by_actuator))]),
    ):
        ratio = np.sqrt(power / max(float(np.median(power)), 1e-300))
        worst = [k for k in np.argsort(-ratio).tolist() if ratio[k] > _OUTLIER]
        if worst:
            more = f" and {len(worst) - _MAX_NAMED} more" if len(worst) > _MAX_NAMED else ""
            parts.append(f"{kind} {', '.join(names[k] for k in worst[:_MAX_NAMED])}{more}")
    return "; ".join(parts)


def check_fit(
    matrix: InteractionMatrix,
    model: SyntheticModel,
    columns: NDArray[np.intp],
    weighted: WeightedMatrix,
    residual: NDArray[np.float64],
    gain: float,
    registration: Registration,
) -> list[str]:
    """Reasons not to use a solution whose steps ended; none if the model fits.

    Parameters
    ----------
    matrix, model, columns
        The fitted columns of the measured matrix, and the synthetic model.
    weighted, residual
        The matrix in units of its standard errors, and data minus model ``(n_slopes, n_modes)`` in the same
        units.
    gain, registration
        The solution.
    """
    reasons = []
    explained, signal = weighted.explained_fraction(residual), weighted.signal_fraction
    misfit, fitted = misfit_fraction(weighted, residual), weighted.data - residual
    significance = float(np.linalg.norm(fitted)) / weighted.noise_level(residual)
    if explained < MIN_EXPLAINED_FRACTION * signal or np.vdot(fitted, weighted.data) <= 0:
        reasons.append(
            f"the model explains {max(explained, 0.0):.0%} of the matrix where noise leaves {signal:.0%} "
            f"to explain; {_probable_cause(matrix, model, columns, weighted)}"
        )
    elif significance < _MIN_SIGNIFICANCE:
        reasons.append(
            f"the slopes hardly follow the commands: the fitted matrix is {significance:.1f} times its "
            "noise; does the mirror move, and does its light reach the sensor?"
        )
    elif gain < 0:
        reasons.append(
            "the gain is negative: the mirror pulls where the model pushes; check its polarity, "
            "or whether the camera is turned by 180 degrees"
        )
    elif misfit > _MAX_MISFIT:
        outliers = describe_outliers(weighted, residual)
        where = f"worst: {outliers}" if outliers else "no part stands out"
        reasons.append(
            f"the model does not fit: {misfit:.0%} of the matrix remain beyond its noise (reduced "
            f"chi-squared {np.mean(np.square(residual)):.3g}); {where}"
        )
    return reasons + _implausible_values(registration)


def _probable_cause(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], weighted: WeightedMatrix
) -> str:
    """Why a model explains next to nothing of a matrix, for the message."""
    hint = check_orientation(matrix, model, columns)
    if hint is not None:
        return hint
    pattern = strongest_pattern_fraction(weighted.data)
    if weighted.data.shape[1] >= _MIN_MODES and pattern > _MAX_PATTERN:
        return (
            f"{pattern:.0%} of the matrix are one pattern of slopes, whatever the command: does the mirror "
            "move, or did the slopes change by themselves?"
        )
    if weighted.signal_fraction < MIN_EXPLAINED_FRACTION:
        return "the matrix is hardly above its noise: does the mirror move, and is its light on the sensor?"
    return "wrong layout, flip or basis, or a registration beyond capture"


def _implausible_values(registration: Registration) -> list[str]:
    """Reasons why a registration cannot be that of a mirror and a sensor that were aligned to each other."""
    reasons = []
    for name in PARAMETERS[3:]:
        value = float(getattr(registration, name))
        if abs(value) > _MAX_SCALING:
            reasons.append(
                f"{name.replace('_', ' ')} is {value:.0f} %, beyond {_MAX_SCALING:.0f} %: check the layout, "
                "the pitch and the number of sub-apertures"
            )
    if abs(registration.rotation) > _MAX_ROTATION:
        reasons.append(
            f"rotation is {registration.rotation:.0f} degrees, beyond {_MAX_ROTATION:.0f}: check the layout "
            "and the flips"
        )
    return reasons
