"""What a converged fit says of the description: parts that do not respond, wrong scales, clocking.

A fit may converge although the description is wrong, because registration and random effects absorb the
difference. Each check names what they absorbed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.goodness_of_fit import describe_outliers
from escape_hw.calibration.sprint.mixed_effects import MixedEffectsState
from escape_hw.calibration.sprint.normal_equations import NormalEquations
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Relative gain below which an actuator (beyond the median one) or sub-aperture is named: half of the others.
_HARDLY_RESPONDS = -0.5
#: Scalings in % of the same sign, and difference between the gains of x and y slopes, from which on they are
#: named. They are correct results, so this limits what is displayed and nothing else.
_NAMED_SCALING, _NAMED_STRETCH = 3.0, 0.02
#: Clocking, in its standard errors, from which on it is named; gains of x and y slopes differ from as many
#: standard errors on.
_SIGNIFICANT = 3.0
#: Share of a variance of the registration from which on an insignificant clocking is named.
_LARGE_SHARE = 0.5
#: Smallest clocking in degrees that is named: a smaller one is printed as zero.
_MIN_ANGLE_DEG = 0.005
_MAX_NAMED = 8


def describe_description(
    weighted: WeightedMatrix,
    residual: NDArray[np.float64],
    registration: Registration,
    state: MixedEffectsState | None,
) -> list[str]:
    """Remarks on what registration and random effects absorbed; none if nothing is remarkable."""
    notes, outliers = _scaling_notes(registration), describe_outliers(weighted, residual)
    if outliers:
        notes.append(
            f"the largest residuals are those of {outliers}; calibration.loss = 'huber' tolerates them"
        )
    if state is None:
        return notes
    response = 1 + state.actuator_gain
    weak = np.flatnonzero(response < (1 + _HARDLY_RESPONDS) * np.median(response))
    if weak.size:
        notes.append(
            f"actuators that hardly respond: {_list([str(a) for a in weak])}; check the mirror, the cables "
            "and the numbering"
        )
    by_axis = state.slope_gain.reshape(2, -1)
    rows, columns = np.nonzero(weighted.valid)
    dark = np.flatnonzero(by_axis.max(axis=0) < _HARDLY_RESPONDS)
    if dark.size:
        places = [f"({rows[k]}, {columns[k]})" for k in dark.tolist()]
        notes.append(
            f"{dark.size} of {rows.size} sub-apertures hardly respond, (row, column) {_list(places)}; are "
            "they lit?"
        )
    lit = by_axis[:, by_axis.max(axis=0) >= _HARDLY_RESPONDS]
    if lit.shape[1] > 1:
        stretch = float(lit[0].mean() - lit[1].mean())
        error = float(np.sqrt(lit.var(axis=1).sum() / lit.shape[1]))
        if abs(stretch) > max(_NAMED_STRETCH, _SIGNIFICANT * error):
            notes.append(
                f"the x slopes are {abs(100 * stretch):.1f} % {'larger' if stretch > 0 else 'smaller'} than "
                "the y slopes, relative to the model; are the pixels or the image stretched?"
            )
    return notes


def _scaling_notes(registration: Registration) -> list[str]:
    scalings = np.array([registration.radial_scaling, registration.tangential_scaling])
    if abs(scalings.sum()) != np.abs(scalings).sum() or np.abs(scalings).min() < _NAMED_SCALING:
        return []
    return [
        f"the mirror is {abs(scalings.mean()):.1f} % {'larger' if scalings.mean() > 0 else 'smaller'} on the "
        "sensor than described: check the pitch of the actuators and the number and size of the "
        "sub-apertures, or correct devices.dm.pitches_across_pupil"
    ]


def _list(names: list[str]) -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return ", ".join(names[:_MAX_NAMED]) + more


@dataclass(frozen=True, slots=True, eq=False)
class Clocking:
    """Rotation of the camera against the grid of sub-apertures.

    Parameters
    ----------
    angle_deg, sigma_deg
        Angle by which all slopes are turned, from +x towards +y, and its standard error.
    bias
        What it does to the registration that is fitted without it ``(5,)``.
    diagonal_stretch
        By how much the slopes along the diagonal x = y are larger than along the other one, relative to the
        model, where this is significant and explains the residual better than the angle does; 0 elsewhere.
    """

    angle_deg: float
    sigma_deg: float
    bias: NDArray[np.float64]
    diagonal_stretch: float = 0.0

    @property
    def covariance(self) -> NDArray[np.float64]:
        """What to add to that of the registration ``(5, 5)``.

        The square of the bias, without what chance contributes to the square of the angle: its unbiased
        estimate, where that is positive.
        """
        square = self.angle_deg**2
        fraction = max(1 - self.sigma_deg**2 / square, 0.0) if square else 0.0
        return np.outer(self.bias, self.bias) * fraction

    def describe(self, sigma: NDArray[np.float64]) -> tuple[str, ...]:
        """A sentence for the operator; none where the angle may be chance and matters little.

        ``sigma (5,)`` are the standard errors of the registration, the clocking's part included.
        """
        if self.diagonal_stretch:
            return (_describe_diagonal_stretch(self.diagonal_stretch),)
        angle = f"{self.angle_deg:.2f} ± {self.sigma_deg:.2f} degrees against the grid of sub-apertures"
        if abs(self.angle_deg) >= max(_SIGNIFICANT * self.sigma_deg, _MIN_ANGLE_DEG):
            return (
                f"the slopes are turned by {angle}: the camera is clocked against the lenslets or the "
                "pyramid; the errors of the registration include what this does to it",
            )
        share = float(np.max(np.diag(self.covariance) / np.square(sigma)))
        if share < _LARGE_SHARE:
            return ()
        return (
            f"the slopes may be turned by {angle}, or not; the errors of the registration are up to "
            f"{1 / np.sqrt(1 - share):.1f} times as large for it: check the camera's clocking, or use more "
            "frames or larger pokes",
        )


def _describe_diagonal_stretch(stretch: float) -> str:
    return (
        f"the slopes along the diagonal x = y are {abs(100 * stretch):.1f} % "
        f"{'larger' if stretch > 0 else 'smaller'} than along the other one, relative to the model; is the "
        "image stretched along a diagonal, or the mirror seen obliquely (calibration.extra_parameters = "
        "['anamorphosis'])?"
    )


def estimate_clocking(weighted: WeightedMatrix, system: NormalEquations) -> Clocking:
    """Estimate the angle from the residual of a fit without it.

    A stretch along the diagonals is estimated likewise, and named instead if it explains more: with that
    misfit, an angle of a few hundredths of a degree may seem significant.
    """
    x, y = np.split(system.model * weighted.by_slope[:, None], 2)
    turned, sheared = (weighted.weigh(np.concatenate(halves)) for halves in ((-y, x), (y, x)))
    angle, sigma, explained, bias = _estimate_change(weighted, system, turned)
    shear, shear_sigma, explained_by_shear, _ = _estimate_change(weighted, system, sheared)
    is_stretched = explained_by_shear > explained and abs(2 * shear) > max(
        _NAMED_STRETCH, _SIGNIFICANT * 2 * shear_sigma
    )
    return Clocking(
        float(np.rad2deg(angle)), float(np.rad2deg(sigma)), bias, 2 * shear if is_stretched else 0.0
    )


def _estimate_change(
    weighted: WeightedMatrix, system: NormalEquations, change: NDArray[np.float64]
) -> tuple[float, float, float, NDArray[np.float64]]:
    """One Gauss-Newton step of the fit extended by a change of the matrix, all other unknowns adjusted.

    Parameters
    ----------
    weighted, system
        The matrix, and the fit without the change.
    change
        ``(n_slopes, n_modes)`` per unit of the estimate, in standard errors.

    Returns
    -------
    value, sigma : float
        Amount of the change. Its standard error is the larger one of those from the noise and from the
        scatter of the scores over columns and sub-apertures, which contains the misfit of the model
        (clusters two ways; Cameron, Gelbach & Miller 2011).
    explained : float
        Sum of squares of the residual that it explains.
    bias : ndarray, ``(5,)``
        What it does to the registration that is fitted without it.
    """
    commands = change @ system.modes.T
    member = (system.lines[:, None] == np.arange(system.lines.max() + 1)).astype(float)
    of_gains = (system.model * change).sum(axis=1)
    products = [
        system.common.reshape(system.n_common, -1) @ change.ravel(),
        (change * system.sampling_derivative).sum(axis=1) @ member,
        of_gains @ system.trends,
        *(np.einsum("sa,sa->a", z, commands) for z in system.actuator_derivatives),
    ]
    coupled = np.concatenate(products) - system.coupling.T @ (of_gains / system.diagonal)
    inner = np.linalg.solve(system.schur_complement, coupled)
    information = float(
        np.square(change).sum() - np.square(of_gains) @ (1 / system.diagonal) - coupled @ inner
    )
    value = float((change * system.residual).sum()) / information
    projected = change - _modelled(system, inner, of_gains)
    score = projected * (system.residual - value * projected)
    by_column, by_sub_aperture = score.sum(axis=0), score.sum(axis=1).reshape(2, -1).sum(axis=0)
    scatter = np.square(by_column).sum() + np.square(by_sub_aperture).sum() - np.square(score).sum()
    noise = weighted.noise_level(system.residual) ** 2 * information
    sigma = float(np.sqrt(max(scatter, noise))) / information
    return value, sigma, value**2 * information, np.asarray(inner[1:6] * value)


def _modelled(
    system: NormalEquations, inner: NDArray[np.float64], of_gains: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What the other unknowns ``(n_inner,)`` and slope gains change of the matrix."""
    k, n_trends = system.n_common, system.trends.shape[1]
    n_kinds, _, n_act = system.actuator_derivatives.shape
    common, by_line, by_trend, by_actuator = np.split(
        inner, np.cumsum([k, len(inner) - k - n_trends - n_kinds * n_act, n_trends])
    )
    gains = (of_gains - system.coupling @ inner) / system.diagonal + system.trends @ by_trend
    acting = (system.actuator_derivatives * by_actuator.reshape(n_kinds, 1, n_act)).sum(axis=0)
    changed = np.tensordot(common, system.common, axes=1) + acting @ system.modes
    return np.asarray(
        changed + gains[:, None] * system.model + by_line[system.lines, None] * system.sampling_derivative
    )
