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
#: Share of the whole scatter that the air's is taken for at least: few states tell a covariance badly.
_LEAST = 0.1

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
    new in every frame and average out as noise does, which the fit's own errors count. So each state is
    fitted twice, under the pokes of every other shape, and what the two have in common is the air's.

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
        terms, seen = np.concatenate([unit[None], derivatives[:5]]), np.stack(slopes, axis=1)
        found.append([_fit(terms[:, :, half::2], seen[:, half::2]) for half in range(2)])
    both = np.array(found) - np.mean(found, axis=0)
    freedom = len(both) - 1
    common = np.prod(both, axis=1).sum(axis=0) / freedom
    whole = np.square(both.mean(axis=1)).sum(axis=0) / freedom
    # Air and pupil have no preferred direction, and few states tell a variance badly.
    for variance in (common, whole):
        variance[:2] = variance[:2].mean()
    return np.asarray(np.sqrt(np.maximum(common, _LEAST * whole)))


def _fit(terms: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Registration ``(5,)`` by matrix and derivatives ``(6, n_slopes, k)`` from slopes ``(n_slopes, k)``."""
    flat = terms.reshape(6, -1)
    gain, *moved = np.linalg.lstsq(flat @ flat.T, flat @ slopes.ravel())[0]
    return np.asarray(np.array(moved) / gain)
