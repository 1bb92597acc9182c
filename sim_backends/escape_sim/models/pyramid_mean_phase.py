"""Mean wavefront of a measurement on a pyramid, from the low orders of its mean slopes.

Seconds of turbulence have a mean wavefront of some radians: tilt, focus, astigmatism and coma. About it a
pyramid responds to a mirror as if the mirror were rotated, scaled and shifted. In closed loop the slopes
stand at the references, which the slopes of a flat wavefront need not do: where the four images are not on a
square, the faces meet in ridges, and the loop stands at a tilt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils, fit_low_orders
from escape_sim.models.pyramid_response import SlopeResponse

#: Rows and columns of pixels of which one is used: the wavefront has nine unknowns.
_STRIDE = 3


def coarse_pixels(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of the valid pixels ``(n, n)`` that suffice for the low orders."""
    coarse = np.zeros_like(valid)
    coarse[::_STRIDE, ::_STRIDE] = valid[::_STRIDE, ::_STRIDE]
    return coarse


def low_order_phases(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Polynomials of first to third degree ``(9, n, n)``, whose slopes are the low orders of slopes.

    ``x (n,)`` are positions along either axis in pupil radii.
    """
    at_x, at_y = np.meshgrid(x, x)
    powers = [(i, degree - i) for degree in (1, 2, 3) for i in range(degree + 1)]
    return np.stack([at_x**i * at_y**j for i, j in powers])


def estimate_mean_phase(
    response: SlopeResponse,
    pixels: NDArray[np.bool_],
    pupils: PyramidPupils,
    nodes: NDArray[np.float64],
    x: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Mean phase ``(n, n)`` in radians over the pupil during a measurement.

    Averaged over the rest of the turbulence, the mean slopes are the response times the mean phase, as far as
    phases are Gaussian (Bussgang 1952). It is found to some per cent (``test_pyramid_mean_phase.py``).

    Parameters
    ----------
    response, pixels
        Response of the sensor at these pixels ``(n_sub, n_sub)``, averaged over the turbulence.
    pupils
        The pupil images, with the low orders of the mean slopes.
    nodes, x
        Positions of the response's nodes and of the samples of the result along either axis, pupil radii.
    """
    if pupils.mean_low_orders is None:
        raise ValueError("the mean slopes of the measurement are unknown")

    def low_orders(slopes: NDArray[np.floating]) -> NDArray[np.float64]:
        return fit_low_orders(slopes.astype(float).reshape(2, -1).T, pixels, pupils.flux).ravel()

    columns = [
        low_orders(response.phase_derivatives @ phase.ravel().astype(np.float32))
        for phase in low_order_phases(nodes)
    ]
    change = pupils.mean_low_orders.ravel() - low_orders(response.mean)
    coefficients = np.linalg.lstsq(np.stack(columns, axis=1), change, rcond=None)[0]
    return np.asarray(np.tensordot(coefficients, low_order_phases(x), 1))
