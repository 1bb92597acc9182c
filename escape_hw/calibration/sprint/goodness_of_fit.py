"""Whether a solution of SPRINT may be used: what does not fit, and where.

A fit counts as converged when its steps ended, the fitted matrix is significant, the registration is within
what the search covers, the data constrain every parameter, and the model explains most of the matrix. The
model *fits* if what it leaves is what the noise and the priors allow, or too small to matter. A converged fit
of a model that does not fit gives a registration whose errors contain the misfit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.flips import Flip
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import GoodnessOfFit, find_outliers
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.coarse_search import MIN_EXPLAINED_FRACTION
from escape_hw.calibration.sprint.orientation import suggest_orientation
from escape_hw.calibration.sprint.tip_tilt import remove_tip_tilt
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.pipeline.statistics import NORMAL_RATIO

#: Largest rms of the residual beyond the noise, relative to that of the matrix. A tenth is what the best
#: known description of a real mirror leaves; beyond it scalings and rotation are those of a wrong model.
_MAX_MISFIT = 0.15
#: The same up to which the model counts as fitting however small the noise: it hardly changes loop gains, and
#: the response of a mirror changes by about as much between its first minutes and later ones.
_TOLERATED_MISFIT = 0.02
#: Mean square of the residual beyond the noise, in variances of the noise, up to which the model counts as
#: fitting: the standard errors grow by a tenth, to which neither they nor those of the matrix are known.
_TOLERATED_EXCESS = 0.21
#: Standard errors that the mean square of the residual must be beyond the noise to count as a misfit.
_SIGNIFICANT = 3.0
#: Norm of the fitted matrix in standard errors below which the sensor does not see the mirror: the largest of
#: some hundred starts of a search in pure noise reaches about 5.
_MIN_SIGNIFICANCE = 10.0
#: One pattern of slopes with a larger fraction of the matrix is not the response to so many modes or more.
_MAX_PATTERN, _MIN_MODES = 0.5, 5
#: Largest scaling in % and rotation in degrees: the search covers half of them.
_MAX_SCALING, _MAX_ROTATION = 20.0, 30.0
#: Sub-apertures or actuators with an outlying residual that are named at most.
_MAX_NAMED = 12

#: Groups of effects of the mirror, as :class:`~.normal_equations.Priors` names them, in messages.
_EFFECTS = {
    "shape_scale": "the coefficients of the shape of the influence functions",
    "actuator_gain": "the gains of the actuators",
    "actuator_width": "the widths of the influence functions",
    "actuator_position": "the positions of the actuators",
}

#: Note of a fit that is not judged.
NOT_JUDGED = "the matrix has no standard errors, so whether the model fits to within its noise is not judged"


@dataclass(frozen=True, slots=True)
class Misfit:
    """Mean square of a residual beyond the noise.

    The mean of the residual over a column is left out: vibration during its measurement shifts all slopes
    alike.

    Parameters
    ----------
    excess
        In variances of the noise; without standard errors all of the residual.
    excess_sigma
        Its standard error.
    fraction
        Rms of the residual beyond the noise, relative to that of the matrix; 0 where it is not significant.
    """

    excess: float
    excess_sigma: float
    fraction: float

    @classmethod
    def of(cls, weighted: WeightedMatrix, residual: NDArray[np.float64]) -> Misfit:
        """Of a weighted matrix, and data minus model ``(n_slopes, n_modes)`` in the same units."""
        square = np.square(remove_tip_tilt(residual))
        noise = weighted.expected_noise if weighted.has_standard_errors else 0.0
        excess, signal = float(square.sum()) - noise, float(np.square(weighted.data).sum()) - noise
        sigma = _error_of_mean(square / weighted.noise_variances[:, None]) if noise else 0.0
        relative = excess / weighted.expected_noise
        is_misfit = relative > _SIGNIFICANT * sigma and signal > 0
        return cls(relative, sigma, float(np.sqrt(excess / signal)) if is_misfit else 0.0)

    @property
    def matters(self) -> bool:
        """Whether it is significant, larger than the noise is uncertain, and no small part of the matrix."""
        return self.fraction > _TOLERATED_MISFIT and self.excess > _TOLERATED_EXCESS


def strongest_pattern_fraction(data: NDArray[np.float64]) -> float:
    """Fraction of a matrix's sum of squares that is one pattern of slopes times a number per column."""
    powers = np.linalg.eigvalsh(data.T @ data)
    return float(powers[-1] / powers.sum())


def _error_of_mean(square: NDArray[np.float64]) -> float:
    """Standard error of the mean of squares ``(n_slopes, n_modes)``, not less than that of independent noise.

    From their scatter over modes and over sub-apertures (clusters two ways), which contains the correlation
    of the noise and the uncertainty of the standard errors. Medians, because a misfit of some columns or
    sub-apertures is what is looked for.
    """
    by_mode, by_sub_aperture = square.mean(axis=0), square.mean(axis=1).reshape(2, -1).mean(axis=0)
    variance = 0.0
    for part in (by_mode, by_sub_aperture):
        deviation = NORMAL_RATIO * float(np.median(np.abs(part - np.median(part))))
        variance += deviation**2 / part.size
    return float(np.sqrt(max(variance, 2.0 / square.size)))


def assess_fit(
    weighted: WeightedMatrix, residual: NDArray[np.float64], excess_scatters: Mapping[str, float]
) -> GoodnessOfFit | None:
    """Whether the model fits, and what it leaves where; ``None`` where neither noise nor priors tell.

    Parameters
    ----------
    weighted, residual
        As for :meth:`Misfit.of`. Without standard errors the residual may be noise.
    excess_scatters
        Groups of effects of the mirror that scatter by more than their priors can, and by how many times.
    """
    if not weighted.has_standard_errors and not excess_scatters:
        return None
    misfit = Misfit.of(weighted, residual)
    fits = not misfit.matters and not excess_scatters
    return GoodnessOfFit(fits, misfit.fraction, *_rms_by_part(weighted, residual))


def describe_misfit(
    weighted: WeightedMatrix, residual: NDArray[np.float64], excess_scatters: Mapping[str, float]
) -> tuple[str, ...]:
    """Notes that the model does not fit, or that this cannot be judged; empty if it fits.

    Parameters as for :func:`assess_fit`.
    """
    chi2 = weighted.reduced_chi_squared(residual)
    by_residual = np.sqrt(chi2) / weighted.noise_level(residual)
    factor = max(float(by_residual), *excess_scatters.values(), 1.0)
    contain = f"the standard errors of the registration contain a factor of {factor:.1f} for it"
    notes: tuple[str, ...] = ()
    if excess_scatters:
        parts = [f"{_EFFECTS[name]} ({ratio:.1f} times)" for name, ratio in excess_scatters.items()]
        notes = (
            f"the model does not fit: {' and '.join(parts)} scatter by more than those of one device differ; "
            "are the influence functions (devices.dm.influence, coupling) and the layout as described? "
            f"{contain[0].upper()}{contain[1:]}",
        )
    if not weighted.has_standard_errors:
        return (*notes, NOT_JUDGED)
    misfit = Misfit.of(weighted, residual)
    if not misfit.matters:
        return notes
    return (
        *notes,
        f"the model does not fit: {misfit.fraction:.0%} of the matrix remain beyond its noise (reduced "
        f"chi-squared {chi2:.3g}, {misfit.excess / misfit.excess_sigma:.0f} standard errors above 1); "
        f"{contain}",
    )


def _rms_by_part(
    weighted: WeightedMatrix, residual: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rms residual of every sub-aperture and of every actuator, in standard errors."""
    by_slope = np.square(residual).mean(axis=1) / weighted.noise_variances
    # The column of an actuator is a combination of those of the modes, and its noise that of the combination.
    inverse = np.linalg.pinv(weighted.modes)
    noise = np.square(inverse).sum(axis=0) * weighted.noise_variances.mean()
    power = np.square(residual @ inverse).mean(axis=0)
    by_actuator = np.divide(power, noise, out=np.zeros_like(power), where=noise > 0)
    return np.sqrt(by_slope.reshape(2, -1).mean(axis=0)), np.sqrt(by_actuator)


def describe_outliers(weighted: WeightedMatrix, residual: NDArray[np.float64]) -> str:
    """Name the sub-apertures and actuators with outlying residuals; empty if there are none."""
    by_sub_aperture, by_actuator = _rms_by_part(weighted, residual)
    rows, columns = np.nonzero(weighted.valid)
    places = [f"({row}, {column})" for row, column in zip(rows, columns, strict=True)]
    parts = []
    for kind, rms, names in (
        ("sub-apertures (row, column)", by_sub_aperture, places),
        ("actuators", by_actuator, [str(a) for a in range(len(by_actuator))]),
    ):
        worst = find_outliers(rms)
        if worst:
            more = f" and {len(worst) - _MAX_NAMED} more" if len(worst) > _MAX_NAMED else ""
            parts.append(f"{kind} {', '.join(names[k] for k in worst[:_MAX_NAMED])}{more}")
    return "; ".join(parts)


def check_fit(
    model: SyntheticModel,
    weighted: WeightedMatrix,
    residual: NDArray[np.float64],
    gain: float,
    registration: Registration,
) -> list[str]:
    """Reasons not to use a solution whose steps ended; none if the model fits.

    Parameters
    ----------
    model
        The synthetic model.
    weighted, residual
        The matrix in units of its standard errors, and data minus model ``(n_slopes, n_modes)`` in the same
        units.
    gain, registration
        The solution.
    """
    reasons = []
    explained, signal = weighted.explained_fraction(residual), weighted.signal_fraction
    misfit, fitted = Misfit.of(weighted, residual).fraction, weighted.data - residual
    significance = float(np.linalg.norm(fitted)) / weighted.noise_level(residual)
    if explained < MIN_EXPLAINED_FRACTION * signal or np.vdot(fitted, weighted.data) <= 0:
        reasons.append(
            f"the model explains {max(explained, 0.0):.0%} of the matrix where noise leaves {signal:.0%} "
            f"to explain; {_probable_cause(weighted)}"
        )
    elif significance < _MIN_SIGNIFICANCE:
        reasons.append(
            f"the slopes hardly follow the commands: the fitted matrix is {significance:.1f} times its "
            "noise; does the mirror move, and does its light reach the sensor?"
        )
    elif gain < 0:
        reasons.append(
            "the gain is negative: the mirror pulls where the model pushes; if its polarity is reversed, "
            f"{suggest_orientation(model, 'none', opposite=True)}"
        )
    elif misfit > _MAX_MISFIT:
        outliers = describe_outliers(weighted, residual)
        where = f"worst: {outliers}" if outliers else "no part stands out"
        reasons.append(
            f"the model does not fit: {misfit:.0%} of the matrix remain beyond its noise (reduced "
            f"chi-squared {weighted.reduced_chi_squared(residual):.3g}); {where}"
        )
    return reasons + _implausible_values(registration, model)


def _probable_cause(weighted: WeightedMatrix) -> str:
    """Why a model explains next to nothing of a matrix, for the message."""
    pattern = strongest_pattern_fraction(weighted.data)
    if weighted.data.shape[1] >= _MIN_MODES and pattern > _MAX_PATTERN:
        return (
            f"{pattern:.0%} of the matrix are one pattern of slopes, whatever the command: does the mirror "
            "move, or did the slopes change by themselves?"
        )
    if weighted.signal_fraction < MIN_EXPLAINED_FRACTION:
        return "the matrix is hardly above its noise: does the mirror move, and is its light on the sensor?"
    return "wrong layout, flip or basis, or a registration beyond capture"


#: Flip that undoes a rotation of the mirror on the sensor, by the number of quarter turns.
_UNDOES: dict[int, Flip] = {1: "turn-270", 2: "turn-180", 3: "turn-90"}


def _implausible_values(registration: Registration, model: SyntheticModel) -> list[str]:
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
        quarter_turns = round(registration.rotation / 90)
        is_quarter_turn = abs(registration.rotation - 90 * quarter_turns) < _MAX_ROTATION
        flip = _UNDOES.get(quarter_turns % 4) if is_quarter_turn else None
        remedy = "check the layout and the flips" if flip is None else suggest_orientation(model, flip)
        reasons.append(
            f"rotation is {registration.rotation:.0f} degrees, beyond {_MAX_ROTATION:.0f}: {remedy}"
        )
    return reasons
