"""Diagnostics of a SPRINT fit.

:func:`describe_degeneracies` names parameters that the data do not separate; :func:`check_orientation` tests
flips, quarter turns, transposition, order and signs of the slopes for a matrix that no registration explains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.flips import Flip, flip_matrix, inverse_flip
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import DifferentiableModel, HasOrientation, SyntheticModel
from escape_hw.calibration.sprint.coarse_search import MIN_EXPLAINED_FRACTION, weigh_low_modes
from escape_hw.calibration.sprint.least_squares import LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Increase of the error of a parameter due to the other ones from which on a degeneracy is reported.
_MIN_INFLATION = 5.0
#: Component of a direction that a parameter must have to be named with it.
_MIN_COMPONENT = 0.3

_LABELS = {
    "gain": "gain",
    "shift_x": "shift x",
    "shift_y": "shift y",
    "rotation": "rotation",
    "radial_scaling": "radial scaling",
    "tangential_scaling": "tangential scaling",
    "width": "width of the influence functions",
    "pedestal": "pedestal of the influence functions",
    "anamorphosis": "anamorphosis",
    "pupil_shift_x": "pupil shift x",
    "pupil_shift_y": "pupil shift y",
}
#: Reasons of the common degeneracies.
_REASONS = (
    ({"gain", "radial scaling", "tangential scaling"}, "a larger mirror has smaller slopes, as a weaker one"),
    ({"gain", "width of the influence functions"}, "wider influence functions have smaller slopes"),
    ({"gain", "pedestal of the influence functions"}, "a pedestal acts as a smaller gain of high modes"),
    (
        {"width of the influence functions", "pedestal of the influence functions"},
        "a pedestal widens an influence function",
    ),
    (
        {"radial scaling", "tangential scaling", "width of the influence functions"},
        "scalings also stretch the influence functions",
    ),
    ({"shift x", "shift y", "rotation"}, "with light on one side only, a rotation acts as a shift"),
    (
        {"shift x", "shift y", "pupil shift x", "pupil shift y"},
        "the mirror moves with the pupil images, and only their rims separate the two",
    ),
    ({"rotation", "anamorphosis"}, "with light along one axis only, a shear acts as a rotation"),
)  # fmt: skip


def describe_degeneracies(covariance: NDArray[np.float64], names: Sequence[str]) -> tuple[str, ...]:
    """Describe groups of parameters with strongly correlated errors, from their covariance ``(n, n)``.

    The eigenvectors of the correlation matrix with the smallest eigenvalues are combinations of parameters
    that are determined much better than each parameter alone.
    """
    sigma = np.sqrt(np.diag(covariance))
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        return ()
    correlation = covariance / np.outer(sigma, sigma)
    eigenvalues, directions = np.linalg.eigh(correlation)
    notes = []
    for eigenvalue, direction in zip(eigenvalues, directions.T, strict=True):
        members_at = np.flatnonzero(np.abs(direction) > _MIN_COMPONENT).tolist()
        if len(members_at) < 2 or eigenvalue <= 0:
            break
        inflation = np.abs(direction[members_at]).max() / np.sqrt(eigenvalue)
        if inflation < _MIN_INFLATION:
            break
        members = [_LABELS.get(names[k], names[k]) for k in members_at]
        reason = next((f" ({why})" for which, why in _REASONS if set(members) <= which), "")
        notes.append(
            f"{', '.join(members[:-1])} and {members[-1]} are hardly separable{reason}: each would be known "
            f"{inflation:.0f} times better if the others were known"
        )
    return tuple(notes)


#: Orientation of the pupil on the sensor, by the flip of the camera's images that restores it.
_ORIENTATIONS: dict[Flip, str] = {
    "left-right": "mirrored left to right",
    "up-down": "upside down",
    "turn-180": "turned by 180 degrees",
    "turn-90": "turned by 90 degrees",
    "turn-270": "turned by 270 degrees",
    "transpose": "transposed",
    "anti-transpose": "transposed about the other diagonal",
}
#: Words of the hints, by which they are recognised.
ORIENTATION_HINT = "the sensor saw the pupil"
_ITERATIONS = 10
#: Standard errors of the fitted matrix by which another orientation must explain more than the described one.
_SIGNIFICANT = 10.0


def check_orientation(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]
) -> str | None:
    """Find a flip, quarter turn, transposition, order or sign of the slopes that explains a matrix.

    Returns
    -------
    str or None
        A hint for the operator; ``None`` if no orientation explains the matrix, or if the model is not
        differentiable and so too slow.
    """
    if not isinstance(model, DifferentiableModel):
        return None
    weighted = weigh_low_modes(matrix, model, columns)
    for flip, reoriented in _reoriented(weighted):
        gain = _gain_of_fit(reoriented, model)
        if gain is not None:
            sign = " and the polarity were reversed" if gain < 0 else ""
            remedy = suggest_orientation(model, flip, opposite=gain < 0)
            return f"it would if {ORIENTATION_HINT} {_ORIENTATIONS[flip]}{sign}: {remedy}"
    if _gain_of_fit(_exchange_slopes(weighted), model) is not None:
        return (
            "it would if its x slopes were its y slopes: check the order of the slopes (matrix.slopes of the "
            "description in 'escape import arrays')"
        )
    gain = _gain_of_fit(_reverse_x_slopes(weighted), model)
    if gain is not None:
        axis = "x" if gain > 0 else "y"
        return (
            f"it would if its {axis} slopes had the other sign: check the sign of the slopes "
            f"(sensor.sign_{axis} of the description in 'escape import arrays')"
        )
    return None


def find_better_orientation(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp], alpha: NDArray[np.float64]
) -> str | None:
    """Find a flip, quarter turn or transposition that explains significantly more than the description.

    Random effects may fit a mirrored pupil, and the signal of few frames may be too small for
    :func:`check_orientation`. So gain and registration alone are fitted to all columns in every orientation.

    Returns
    -------
    str or None
        As for :func:`check_orientation`. ``alpha``: registration ``(5,)`` that was found.
    """
    if not isinstance(model, DifferentiableModel):
        return None
    weighted = WeightedMatrix.from_columns(matrix, columns)
    described = max(_explained_by_fit(weighted, model, start) for start in (alpha, np.zeros(5)))
    explained = {
        flip: _explained_by_fit(reoriented, model, np.zeros(5)) for flip, reoriented in _reoriented(weighted)
    }
    best = max(explained, key=lambda flip: explained[flip])
    if explained[best] < described + _SIGNIFICANT**2 * weighted.noise_level(weighted.data) ** 2:
        return None
    remedy = suggest_orientation(model, best)
    return f"it would explain more if {ORIENTATION_HINT} {_ORIENTATIONS[best]}: {remedy}"


def _explained_by_fit(
    weighted: WeightedMatrix, model: DifferentiableModel, start: NDArray[np.float64]
) -> float:
    """Sum of squares that a registration-only fit of positive gain explains, 0 without one."""
    *_, fit = LeastSquaresProblem(weighted, model).descend(start, _ITERATIONS)
    return float(np.square(weighted.data).sum() - np.square(fit.residual).sum()) if fit.gain > 0 else 0.0


def _gain_of_fit(weighted: WeightedMatrix, model: DifferentiableModel) -> float | None:
    """Gain of a registration-only fit; ``None`` if the model does not explain the matrix."""
    *_, fit = LeastSquaresProblem(weighted, model).descend(np.zeros(5), _ITERATIONS)
    explained = weighted.explained_fraction(fit.residual)
    return fit.gain if explained >= MIN_EXPLAINED_FRACTION * weighted.signal_fraction else None


def _exchange_slopes(weighted: WeightedMatrix) -> WeightedMatrix:
    """The matrix with its x slopes as y slopes and the other way round."""
    half = len(weighted.data) // 2
    return replace(
        weighted, data=np.roll(weighted.data, half, axis=0), by_slope=np.roll(weighted.by_slope, half)
    )


def _reverse_x_slopes(weighted: WeightedMatrix) -> WeightedMatrix:
    """The matrix with the opposite sign of its x slopes."""
    half = len(weighted.data) // 2
    return replace(weighted, data=np.concatenate([-weighted.data[:half], weighted.data[half:]]))


def suggest_orientation(model: SyntheticModel, flip: Flip, *, opposite: bool = False) -> str:
    """What to set so that images are turned further by ``flip``, and commands have the ``opposite`` sign."""
    if isinstance(model, HasOrientation):
        return model.suggest_orientation(flip, opposite=opposite)
    return "check the layout, the flips and the polarity"


def _reoriented(weighted: WeightedMatrix) -> Iterator[tuple[Flip, WeightedMatrix]]:
    """The matrix as seen by a sensor in each orientation; slopes that it would not have get no weight."""
    valid = weighted.valid
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(int(valid.sum()))
    middle = (np.array(valid.shape) - 1) / 2
    positions = np.argwhere(valid)
    n = len(positions)
    for flip in _ORIENTATIONS:
        # Where the restored image has its content from; axes (row, column) instead of (x, y).
        rotation = flip_matrix(inverse_flip(flip))[::-1, ::-1]
        if valid.shape[0] != valid.shape[1] and rotation[0, 0] == 0:
            continue
        target = np.rint((positions - middle) @ rotation.T + middle).astype(int)
        source = number[target[:, 0], target[:, 1]]
        data, noise = np.zeros_like(weighted.data), np.full(2 * n, np.inf)
        # Slopes (x, y) transform as the offsets (row, column) do.
        for half, axis in ((0, 1), (1, 0)):
            along = int(np.flatnonzero(rotation.T[axis])[0])
            from_half = 1 - along
            rows = np.flatnonzero(source >= 0)
            at = source[rows] + from_half * n
            data[rows + half * n] = rotation.T[axis, along] * weighted.data[at]
            noise[rows + half * n] = weighted.by_slope[at]
        yield flip, replace(weighted, data=data, by_slope=noise)
