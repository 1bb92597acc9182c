"""Finds the lenslet grid, the valid sub-apertures and the references on mean frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.pupil_outline import LensletLight, PupilOutline, fit_pupil_outline
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes, subaperture_windows

#: Largest relative deviation of the pitch from the nominal one.
_PITCH_RANGE = 0.03
#: Least contrast of the light folded at the pitch. Spots under the strongest phase screen of the bench have
#: 0.85, spots off the lattice less than 0.2.
_CONTRAST = 0.3
#: Contrast above that of the noise of a dark camera, which is up to 0.06.
_NOISE_CONTRAST = 0.1
#: Distance of a spot from the lattice, in median distances, above which it is left out.
_MAX_DISTANCE = 5.0
#: Ratio of a pixel to its brightest neighbour above which it is hot and not part of a spot.
_HOT_PIXEL_RATIO = 10.0
#: Flux below which a sub-aperture is dark, relative to the brightest.
_LEAST_FLUX = 0.02
#: Fewest lit sub-apertures.
_MIN_VALID = 6


def _comb_power(profile: NDArray[np.float64], pitch: float) -> complex:
    """Fourier component of a profile at one period per ``pitch``."""
    return complex(np.sum(profile * np.exp(-2j * np.pi * np.arange(profile.size) / pitch)))


def _pitch_and_phase(image: NDArray[np.float64], nominal: float) -> tuple[float, float, float]:
    """Common pitch of both axes, and the position of one lenslet centre along x and y."""
    profiles = [image.sum(axis=0), image.sum(axis=1)]
    profiles = [p - ndimage.uniform_filter1d(p, round(nominal) | 1) for p in profiles]

    def negative_power(pitch: float) -> float:
        return -sum(abs(_comb_power(p, pitch)) ** 2 for p in profiles)

    # The scan is finer than the width of the peak, about pitch^2 / length.
    trial = nominal * (1 + np.linspace(-_PITCH_RANGE, _PITCH_RANGE, 241))
    best = float(trial[np.argmin([negative_power(t) for t in trial])])
    step = float(trial[1] - trial[0])
    pitch = float(
        optimize.minimize_scalar(negative_power, bounds=(best - step, best + step), method="bounded").x
    )
    phases = [-np.angle(_comb_power(p, pitch)) * pitch / (2 * np.pi) for p in profiles]
    return pitch, float(phases[0]), float(phases[1])


def _contrast(light: NDArray[np.float64], pitch: float) -> float:
    """Contrast of the light folded at a pitch: 1 for points on the lattice, 0 for even light."""
    return sum(abs(_comb_power(light.sum(axis=axis), pitch)) for axis in (0, 1)) / (2 * float(light.sum()))


def _check_lattice(light: NDArray[np.float64], pitch: float, nominal: float) -> None:
    """Raise :class:`CalibrationError` unless the spots form a lattice of this pitch."""
    contrast = _contrast(light, pitch)
    if contrast < _NOISE_CONTRAST:
        raise CalibrationError(
            "no spots on the wavefront sensor, only noise or even light; "
            "check source, beam stop, exposure and sensor.pitch_px"
        )
    if abs(pitch / nominal - 1) > _PITCH_RANGE:
        raise CalibrationError(
            f"the fitted lenslet pitch is {pitch:.3f} pixels, that of the design {nominal}; "
            "check sensor.pitch_px and the binning"
        )
    # Spots two or three pitches apart have contrast at a harmonic.
    wider = max(_contrast(light, m * pitch) for m in (2, 3))
    if contrast < _CONTRAST or wider > contrast / 2:
        raise CalibrationError(
            f"the spots on the wavefront sensor are not {nominal} pixels apart, as in the design; "
            "check sensor.pitch_px and the binning, and that the light comes through the lenslets"
        )


def _lattice_fit(
    rows: NDArray[np.intp], columns: NDArray[np.intp], spots: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Weighted least-squares pitch and origin (x, y) of spots on a square lattice.

    Outliers, such as a window with a hot pixel, are left out.
    """
    n = rows.size
    design = np.zeros((2, n, 3))
    design[0, :, 0], design[1, :, 0] = columns, rows
    design[0, :, 1] = design[1, :, 2] = 1.0
    w: NDArray[np.floating] = np.sqrt(weight)
    solution: NDArray[np.floating] = np.zeros(3)
    for _ in range(3):
        solution = np.linalg.lstsq(
            (design * w[:, None]).reshape(2 * n, 3), (spots.T * w).ravel(), rcond=None
        )[0]
        off = np.hypot(*(spots.T - design @ solution))
        w = np.sqrt(weight) * (off <= _MAX_DISTANCE * np.median(off) + 1e-6)
    return float(solution[0]), float(solution[1]), float(solution[2])


def find_lenslet_grid(
    mean_frame: NDArray[np.float32],
    *,
    n_sub: int,
    nominal_pitch_px: float,
    threshold: float,
    min_flux: float,
    references: str = "lattice",
    valid: NDArray[np.bool_] | None = None,
) -> SubApertureGrid:
    """Find pitch, offset, valid sub-apertures and references on a mean frame.

    With turbulence, the lattice fitted to all spots has only the error of the mean tilt and focus.

    Parameters
    ----------
    mean_frame
        Mean of dark-subtracted frames in counts ``(rows, columns)``.
    n_sub
        Number of lenslets across the grid.
    nominal_pitch_px
        Design pitch in pixels; the real one may differ by 3 %.
    threshold
        Centre-of-gravity threshold in counts.
    min_flux
        Least flux of a valid sub-aperture, relative to the brightest.
    references
        ``"lattice"``: the lattice points (without a source); ``"mean"``: the mean spot positions (with a
        source).
    valid
        Valid sub-apertures ``(n_sub, n_sub)``; by default those above ``min_flux``.

    Raises
    ------
    CalibrationError
        No regular spots, too few lit sub-apertures, or valid ones that the camera does not show.
    """
    if references not in ("lattice", "mean"):
        raise ValueError(f"references is {references!r}; choose 'lattice' or 'mean'")
    image = _without_hot_pixels(np.asarray(mean_frame, dtype=np.float64), n_sub)
    light = np.maximum(image - threshold, 0.0)
    if not light.any():
        raise CalibrationError(
            "no light above the threshold on the wavefront sensor; check source and exposure"
        )
    pitch, x, y = _pitch_and_phase(light, nominal_pitch_px)
    outline = _find_pupil(image, light, pitch, (x, y), n_sub)
    column, row = outline.first_lenslet(n_sub)
    x, y = x + column * pitch, y + row * pitch
    for _ in range(3):
        grid = _build_grid(image, n_sub, pitch, (x, y), min_flux)
        spots = grid.centres_px() + _measure_spots(grid, light)
        rows, columns = np.nonzero(grid.valid)
        pitch, x, y = _lattice_fit(rows, columns, spots, np.minimum(grid.flux[grid.valid], 1.0).astype(float))
    _check_lattice(light, pitch, nominal_pitch_px)
    grid = _build_grid(image, n_sub, pitch, (x, y), min_flux)
    if valid is not None:
        grid = _with_valid(grid, valid)
    if references == "mean":
        grid = replace(grid, references_px=_measure_spots(grid, light).astype(np.float32))
    return replace(grid, numbering_offsets=outline.competing_offsets(n_sub))


def _without_hot_pixels(image: NDArray[np.float64], n_sub: int) -> NDArray[np.float64]:
    """The image with isolated bright pixels lowered to their brightest neighbour.

    A hot pixel has as much light as a spot and would make a dark sub-aperture valid.
    """
    around = np.ones((3, 3), dtype=bool)
    around[1, 1] = False
    brightest = ndimage.maximum_filter(image, footprint=around, mode="nearest")
    # In dark areas single pixels exceed their neighbours by noise; only bright ones matter.
    hot = (image > _HOT_PIXEL_RATIO * np.maximum(brightest, 0.0)) & (image > np.percentile(image, 99))
    if hot.sum() > n_sub**2 / 10:
        # These are spots of a single pixel.
        return image
    return np.where(hot, brightest, image)


def _find_pupil(
    image: NDArray[np.float64],
    light: NDArray[np.float64],
    pitch: float,
    origin: tuple[float, float],
    n_sub: int,
) -> PupilOutline:
    """Find the pupil on the lattice with a point at ``origin``."""
    smooth = ndimage.uniform_filter(light, round(pitch))
    # Opening by more than one pitch removes hot pixels, which would extend the outline.
    kernel_size = round(1.5 * pitch) | 1
    opened = ndimage.maximum_filter(ndimage.minimum_filter(smooth, kernel_size, mode="constant"), kernel_size)
    lit = opened > 0.1 * np.percentile(opened, 99)
    if not lit.any():
        raise CalibrationError(
            "single bright pixels but no illuminated pupil on the wavefront sensor; "
            "check source, exposure and sensor.pitch_px"
        )
    rows, columns = np.nonzero(lit)
    x, y = (
        (0.5 * float(at.min() + at.max()) - start) / pitch
        for at, start in zip((columns, rows), origin, strict=True)
    )
    return fit_pupil_outline(LensletLight.from_image(image, pitch, origin), n_sub, (x, y))


def _build_grid(
    image: NDArray[np.float64], n_sub: int, pitch: float, origin: tuple[float, float], min_flux: float
) -> SubApertureGrid:
    line = np.arange(n_sub) * pitch
    centres = np.stack([a.ravel() for a in np.meshgrid(origin[0] + line, origin[1] + line)], axis=1)
    rows, columns = image.shape
    boxes = subaperture_windows(centres, pitch, (rows, columns))
    area = np.pad(image.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    top, end, left, right = boxes.T
    flux = area[end, right] - area[top, right] - area[end, left] + area[top, left]
    complete = (end - top >= int(pitch)) & (right - left >= int(pitch))
    flux = np.where(complete, np.maximum(flux, 0.0), 0.0).reshape(n_sub, n_sub)
    if not flux.any():
        raise CalibrationError(
            "no sub-aperture is brighter than the background; check source, exposure, the camera region and "
            "sensor.pitch_px"
        )
    # Relative to the 95th percentile, which hot pixels do not affect.
    counts = float(np.percentile(flux[flux > _LEAST_FLUX * flux.max()], 95))
    flux = flux / counts
    valid = flux >= min_flux
    if valid.sum() < _MIN_VALID:
        raise CalibrationError(
            f"only {int(valid.sum())} sub-apertures are lit above {min_flux:.0%} of the brightest; "
            "check the beam, the camera region and sensor.min_flux"
        )
    return SubApertureGrid(
        pitch, origin, valid, np.zeros((int(valid.sum()), 2), np.float32), flux.astype(np.float32), counts
    )


def _with_valid(grid: SubApertureGrid, valid: NDArray[np.bool_]) -> SubApertureGrid:
    """The grid with a given set of valid sub-apertures."""
    dark = valid & (grid.flux < _LEAST_FLUX)
    if dark.any():
        row, column = np.argwhere(dark)[0]
        raise CalibrationError(
            f"{int(dark.sum())} of the {int(valid.sum())} sub-apertures in sensor.valid are dark or beyond "
            f"the camera region, the first in row {row}, column {column} (from 0); correct sensor.valid, "
            "sensor.n_sub or devices.wfs.region"
        )
    return replace(grid, valid=valid, references_px=np.zeros((int(valid.sum()), 2), np.float32))


def _measure_spots(grid: SubApertureGrid, light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spot offsets ``(n_valid, 2)`` on a mean frame, which is scaled to use the range of 16 bits."""
    rows, columns = light.shape
    extractor = ShackHartmannSlopes(grid, (rows, columns), threshold=0.0)
    scale = 60000.0 / float(light.max())
    slopes = extractor(np.asarray(light * scale, dtype=np.uint16))
    return np.asarray(slopes.reshape(2, -1).T, dtype=np.float64)
