"""Measured geometry of a pyramid sensor on its camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.api.sensor import SensorGeometry
from escape_hw.deprecation import renamed_members

#: Names of the four pupil images in order of their index, ``2 * lower + right``.
IMAGES = ("upper left", "upper right", "lower left", "lower right")

#: Pixels within this fraction of the radius are not cut by the rim of an image.
_INNER_RADIUS = 0.9


@renamed_members(looks="n_effective", steady="persistent_fraction")
@dataclass(frozen=True, slots=True, eq=False)
class PyramidPupils(SensorGeometry):
    """The four pupil images on the camera.

    The slopes of a pupil pixel (Ragazzoni 1996), before the references are subtracted, are

        sx = (UR + LR - UL - LL) / norm        sy = (LL + LR - UL - UR) / norm

    where UL, UR, LL and LR are the counts at this pixel in the upper left, upper right, lower left and
    lower right image, and ``norm`` is the sum of the four, averaged over all valid pixels (``global``) or
    of this pixel (``local``).

    Parameters
    ----------
    centres_px
        Centres of the images ``(4, 2)`` as (x, y) in pixels of the region, pixel centres at integers, in
        the order of :data:`IMAGES`.
    diameter_px
        Diameter of an image in pixels.
    corners_px
        First pixel ``(4, 2)`` as (x, y) of the n x n box around each image. The centre of a box is within
        half a pixel of the centre of its image.
    valid
        Valid pixels, boolean ``(n, n)``.
    references
        Slopes of the flat wavefront ``(n_valid, 2)`` as (x, y).
    flux
        Flux of every pixel, summed over the images, relative to a bright one ``(n, n)``.
    counts
        Counts per frame of a bright pixel, summed over the images; 0 if unknown.
    motion
        Temporal rms of the slopes during the measurement that a model of this sensor describes.
    background
        Background level in counts that was subtracted in the absence of a dark frame.
    normalisation
        ``"global"`` or ``"local"``.
    modulation
        Modulation radius in lambda/D during the measurement.
    centre_sigma_px
        Standard error per axis of the mean of the four centres, pixels; 0 if unknown. The shift of the
        mirror refers to this mean.
    pokes
        Rms surface over the pupil of the random pokes during the measurement, all modes, as fraction of
        full stroke. Like the turbulence, the pokes change the sensitivity of the sensor.
    n_effective
        Number of independent realisations of the turbulence in the measurement; 0 if unknown.
    persistent_fraction
        Fraction of the slope variance that is correlated over two frames: turbulence, not pokes.
    residual_tilt
        Temporal rms per axis of the slopes' mean over the pupil in closed loop, where the modes have taken
        most of the turbulence; 0 in open loop.
    mean_low_orders
        Low orders of the mean slopes in the measurement, before the references are subtracted:
        coefficients ``(6, 2)`` as (x, y) of :func:`low_order_terms`; ``None`` if unknown.
    """

    kind: ClassVar[str] = "pyramid"
    slope_unit: ClassVar[str] = "1"
    elements: ClassVar[str] = "pupil pixels"
    short_run_note: ClassVar[str] = (
        "the centres of the pupil images were measured in {seconds:.1f} s of turbulence and may be off by "
        "some hundredths of a pixel; so may the shifts of the registration, which refer to them"
    )

    centres_px: NDArray[np.float64]
    diameter_px: float
    corners_px: NDArray[np.intp]
    valid: NDArray[np.bool_]
    references: NDArray[np.float32]
    flux: NDArray[np.float32]
    counts: float = 0.0
    motion: float = 0.0
    background: float = 0.0
    normalisation: str = "global"
    modulation: float = 0.0
    centre_sigma_px: float = 0.0
    pokes: float = 0.0
    n_effective: float = 0.0
    persistent_fraction: float = 0.0
    residual_tilt: float = 0.0
    mean_low_orders: NDArray[np.float64] | None = None
    __repr__ = short_repr

    def outlines(self) -> tuple[tuple[float, float, float], ...]:
        """See :meth:`SensorGeometry.outlines`."""
        return tuple((float(x), float(y), self.diameter_px / 2) for x, y in self.centres_px)

    def with_slope_statistics(
        self,
        rms: float,
        pokes: float = 0.0,
        n_effective: float = 0.0,
        persistent_fraction: float = 0.0,
        residual_tilt: float = 0.0,
        mean: NDArray[np.float64] | None = None,
    ) -> PyramidPupils:
        """See :meth:`SensorGeometry.with_slope_statistics`."""
        low_orders = None
        if mean is not None:
            slopes = mean.reshape(2, -1).T + self.references
            low_orders = fit_low_orders(slopes, self.valid, self.flux)
        return replace(
            self, motion=rms, pokes=pokes, n_effective=n_effective, persistent_fraction=persistent_fraction,
            residual_tilt=residual_tilt, mean_low_orders=low_orders,
        )  # fmt: skip

    def with_mean_slopes(self, mean: NDArray[np.float64]) -> PyramidPupils:
        """See :meth:`SensorGeometry.with_mean_slopes`; only the part that is not smooth is added."""
        new_references = self.references + remove_low_orders(mean.reshape(2, -1).T, self.valid, self.flux)
        return replace(self, references=new_references.astype(np.float32))


def low_order_terms(valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Second-degree polynomials over the pupil at the valid pixels ``(n_valid, 6)``; its radius is 1."""
    n = valid.shape[0]
    rows, columns = np.nonzero(valid)
    x, y = (2 * columns - (n - 1)) / n, (2 * rows - (n - 1)) / n
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def fit_low_orders(
    slopes: NDArray[np.float64], valid: NDArray[np.bool_], flux: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Coefficients ``(6, 2)`` of the low orders of slopes ``(n_valid, 2)``, fitted in the inner pupil."""
    terms = low_order_terms(valid)
    inner = np.square(terms[:, 1:3]).sum(axis=1) < _INNER_RADIUS**2
    weight = np.sqrt(np.maximum(flux[valid], 0.0))[inner, None]
    return np.asarray(np.linalg.lstsq(terms[inner] * weight, slopes[inner] * weight, rcond=None)[0])


def remove_low_orders(
    slopes: NDArray[np.float64], valid: NDArray[np.bool_], flux: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Mean slopes under turbulence without their smooth part, which may be due to the turbulence.

    The mean turbulence over seconds consists of tilt, focus, astigmatism and coma. Their slopes are
    second-degree polynomials over the pupil, which are fitted in the inner pupil and subtracted everywhere.
    The remainder is instrumental: unequal faces and pixels, and the rims of the four images, which are
    sampled differently. A flat wavefront has no smooth slopes on a pyramid whose tip is on the axis.

    Parameters
    ----------
    slopes
        ``(n_valid, 2)`` as (x, y).
    valid, flux
        As in :class:`PyramidPupils`, ``(n, n)``.
    """
    return np.asarray(slopes - low_order_terms(valid) @ fit_low_orders(slopes, valid, flux))


def pupil_boxes(centres_px: NDArray[np.float64], n: int) -> NDArray[np.intp]:
    """First pixels ``(4, 2)`` as (x, y) of the n x n boxes centred closest to ``centres_px`` ``(4, 2)``."""
    return np.rint(np.asarray(centres_px) - (n - 1) / 2).astype(np.intp)
