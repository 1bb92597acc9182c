"""Which parameters a fit cannot tell apart, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: A parameter's error must grow by this factor, by not knowing the others, before anybody is told.
_INFLATED = 5.0
#: Share of a direction that a parameter must have to be named with it.
_PART = 0.3

_WORDS = {
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


def degeneracies(covariance: NDArray[np.float64], names: Sequence[str]) -> tuple[str, ...]:
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
    shares, directions = np.linalg.eigh(correlation)
    notes = []
    for share, direction in zip(shares, directions.T, strict=True):
        part = np.flatnonzero(np.abs(direction) > _PART).tolist()
        if len(part) < 2 or share <= 0:
            break
        inflated = np.abs(direction[part]).max() / np.sqrt(share)
        if inflated < _INFLATED:
            break
        members = [_WORDS.get(names[k], names[k]) for k in part]
        reason = next((f" ({why})" for which, why in _REASONS if set(members) <= which), "")
        notes.append(
            f"{_listed(members)} can hardly be told apart{reason}: each would be known "
            f"{inflated:.0f} times better if the others were known"
        )
    return tuple(notes)


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"
