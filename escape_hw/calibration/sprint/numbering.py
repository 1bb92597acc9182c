"""Effect of an uncertain numbering of the sub-apertures on the registration.

A matrix does not show which lenslet of the camera's lattice is the first one of the pupil: with the next one
the mirror is shifted by a sub-aperture less. Where the light on the sensor does not exclude that, the errors
of the shift contain it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.synthetic_model import HasNumberingOffsets, SyntheticModel

#: Competing numberings of an axis, beyond which only the first and last are named.
_MAX_NAMED = 4


def _offsets(model: SyntheticModel) -> tuple[tuple[int, int], tuple[int, int]]:
    return model.numbering_offsets if isinstance(model, HasNumberingOffsets) else ((0, 0), (0, 0))


def numbering_covariance(model: SyntheticModel) -> NDArray[np.float64]:
    """What to add to the covariance of a registration ``(5, 5)``: whole sub-apertures of either shift."""
    largest = [max(-low, high) for low, high in _offsets(model)]
    return np.diag(np.square([100.0 * largest[0], 100.0 * largest[1], 0.0, 0.0, 0.0]))


def describe_numbering(model: SyntheticModel, registration: Registration) -> tuple[str, ...]:
    """Note on each axis whose numbering is uncertain, with the shifts of the other numberings."""
    notes = []
    shifts = registration.to_array()[:2]
    for name, axis, shift, (low, high) in zip(PARAMETERS, "xy", shifts, _offsets(model), strict=False):
        others = [k for k in range(low, high + 1) if k]
        if not others:
            continue
        # The next lenslet as the first one: the pupil is further along, the mirror shifted by less.
        texts = [f"{k:+d} ({name} {shift - 100 * k:.1f} %)" for k in others]
        listed = ", ".join(texts) if len(texts) <= _MAX_NAMED else f"{texts[0]} to {texts[-1]}"
        closest = min((0, *others), key=lambda k: abs(shift - 100 * k))
        smallest = "this one" if closest == 0 else f"{closest:+d}"
        notes.append(
            f"the numbering of the lenslets along {axis} is uncertain: the light on the sensor does not "
            f"exclude an offset of {listed}; the shift is smallest with {smallest}, and its error includes "
            "them. To exclude them, centre or widen the beam, show the whole pupil in devices.wfs.region, "
            "and check sensor.n_sub"
        )
    return tuple(notes)
