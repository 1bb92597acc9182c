"""By how much one state of the air makes a mirror seem to sit elsewhere on a pyramid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.pyramid import PyramidOptics

#: Rms path of a shape in waves: small enough for differences to be derivatives.
_STEP = 0.01

Jacobian = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]


def air_scatter(
    optics: PyramidOptics,
    pupils: PyramidPupils,
    phases: NDArray[np.float64],
    shapes: NDArray[np.float64],
    influence_m: NDArray[np.float64],
    jacobian: Jacobian,
) -> NDArray[np.float64]:
    """Standard deviation over states of the air of the registration that fits best ``(5,)``.

    A pyramid answers differently under every wavefront: where this is steep a pixel is saturated, and
    what it still sees lies a little aside. A model knows the mean only. Its registration therefore
    errs by this much over the root of the number of states that a measurement averaged, however little
    noise there was. Told by frames: differences of two with the mirror's shape up and down. Pokes are
    new in every frame, so what they do to a state of the air is averaged.

    Parameters
    ----------
    optics
        The nominal sensor.
    pupils
        Its geometry.
    phases
        Random states ``(count, k, n, n)`` in radians: turbulence, with other pokes for every shape.
    shapes
        Commands ``(count, n_act, k)`` whose response is looked at under each state, of all modes of a
        calibration: fine shapes tell the registration better than coarse ones.
    influence_m
        Optical path per unit command of each actuator ``(n_act, n, n)`` in metres.
    jacobian
        The model's matrix for shapes ``(n_act, k)``, and its derivatives by registration and width.
    """
    found = []
    for states, commands in zip(phases * (optics.wavelength_m / (2 * np.pi)), shapes, strict=True):
        paths = np.tensordot(commands.T, influence_m, 1)
        step = _STEP * optics.wavelength_m / float(paths.std())
        slopes = [
            slopes_of_image(optics.frame((state + step * path).astype(np.float32)), pupils)
            - slopes_of_image(optics.frame((state - step * path).astype(np.float32)), pupils)
            for state, path in zip(states, paths, strict=True)
        ]
        unit, derivatives = jacobian(commands)
        terms = np.concatenate([unit[None], derivatives[:5]]).reshape(6, -1)
        gain, *moved = np.linalg.lstsq(terms @ terms.T, terms @ np.stack(slopes, axis=1).ravel())[0]
        found.append(np.array(moved) / gain)
    variance = np.var(found, axis=0, ddof=1)
    # Air and pupil have no preferred direction, and few states tell a variance badly.
    variance[:2] = variance[:2].mean()
    return np.asarray(np.sqrt(variance))
