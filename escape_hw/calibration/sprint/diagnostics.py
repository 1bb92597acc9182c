"""Diagnostics of a SPRINT fit: parameters that the data do not separate, and the orientation check (flips, transpose, quarter turns) of a matrix that no registration explains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.sprint.coarse_search import MIN_EXPLAINED_FRACTION, N_COARSE_MODES
from escape_hw.calibration.sprint.least_squares import LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: A parameter's error must grow by this factor, by not knowing the others, before anybody is told.
_MIN_INFLATION = 5.0
#: Share of a direction that a parameter must have to be named with it.
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
#: What stands behind the usual ones.
_REASONS = (
    ({"gain", "radial scaling", "tangential scaling"}, "a larger mirror has flatter slopes, as a weaker one"),
    ({"gain", "width of the influence functions"}, "wider influence functions have flatter slopes"),
    ({"gain", "pedestal of the influence functions"}, "a pedestal looks like a smaller gain on high modes"),
    (
        {"width of the influence functions", "pedestal of the influence functions"},
        "a pedestal widens an influence function",
    ),
    (
        {"radial scaling", "tangential scaling", "width of the influence functions"},
        "scalings stretch the influence functions, too",
    ),
    ({"shift x", "shift y", "rotation"}, "lit on one side only, a turn looks like a shift"),
    (
        {"shift x", "shift y", "pupil shift x", "pupil shift y"},
        "the mirror moves with the pupil's images, and only their rims say which of them it was",
    ),
    ({"rotation", "anamorphosis"}, "lit along one axis only, a shear looks like a turn"),
)  # fmt: skip


def describe_degeneracies(covariance: NDArray[np.float64], names: Sequence[str]) -> tuple[str, ...]:
    """Sentences on the directions along which the errors of several parameters go together.

    The eigenvectors of the correlation matrix with the smallest eigenvalues are the combinations that are
    known much better than their members are: each member alone is uncertain because the others are.

    Parameters
    ----------
    covariance
        Of the parameters ``(n, n)``, or of their first ones.
    names
        What they are called ``(n,)``.
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
            f"{_join_words(members)} can hardly be told apart{reason}: each would be known "
            f"{inflation:.0f} times better if the others were known"
        )
    return tuple(notes)


def _join_words(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"


#: How the sensor would see the pupil, and the map of (row, column) offsets from the middle.
_ORIENTATIONS = {
    "mirrored left to right": ((1, 0), (0, -1)),
    "upside down": ((-1, 0), (0, 1)),
    "turned by 180 degrees": ((-1, 0), (0, -1)),
    "turned by 90 degrees": ((0, -1), (1, 0)),
    "turned by 270 degrees": ((0, 1), (-1, 0)),
    "transposed": ((0, 1), (1, 0)),
    "transposed about the other diagonal": ((0, -1), (-1, 0)),
}
_ITERATIONS = 10


def check_orientation(
    matrix: InteractionMatrix, model: SyntheticModel, columns: NDArray[np.intp]
) -> str | None:
    """What would explain a matrix that no registration explains.

    Parameters
    ----------
    matrix, model, columns
        As for SPRINT.

    Returns
    -------
    str or None
        A sentence for the operator; ``None`` if nothing helps, or if the model is too slow to try.
    """
    if not isinstance(model, DifferentiableModel):
        return None
    weighted = WeightedMatrix.of(matrix, np.sort(columns)[:N_COARSE_MODES])
    for orientation, reoriented in _reoriented(weighted):
        problem = LeastSquaresProblem(reoriented, model)
        *_, fit = problem.descend(np.zeros(5), _ITERATIONS)
        if reoriented.explained_fraction(fit.residual) >= MIN_EXPLAINED_FRACTION * reoriented.signal_fraction:
            sign = " and the polarity were reversed" if fit.gain < 0 else ""
            return f"it would if the sensor saw the pupil {orientation}{sign}; check the layout and the flips"
    return None


def _reoriented(weighted: WeightedMatrix) -> Iterator[tuple[str, WeightedMatrix]]:
    """The matrix as a sensor turned or flipped would have seen it; slopes it would not have are left out."""
    valid = weighted.valid
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(int(valid.sum()))
    middle = (np.array(valid.shape) - 1) / 2
    positions = np.argwhere(valid)
    n = len(positions)
    for orientation, transform in _ORIENTATIONS.items():
        rotation = np.array(transform)
        if valid.shape[0] != valid.shape[1] and rotation[0, 0] == 0:
            continue
        target = np.rint((positions - middle) @ rotation.T + middle).astype(int)
        source = number[target[:, 0], target[:, 1]]
        data, noise = np.zeros_like(weighted.data), np.full(2 * n, np.inf)
        # Slopes are vectors (x, y) against offsets (row, column): they turn as the offsets do.
        for half, axis in ((0, 1), (1, 0)):
            along = int(np.flatnonzero(rotation.T[axis])[0])
            from_half = 1 - along
            rows = np.flatnonzero(source >= 0)
            at = source[rows] + from_half * n
            data[rows + half * n] = rotation.T[axis, along] * weighted.data[at]
            noise[rows + half * n] = weighted.by_slope[at]
        yield orientation, replace(weighted, data=data, by_slope=noise)
