"""Parameters of a SPRINT fit that the data do not separate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
