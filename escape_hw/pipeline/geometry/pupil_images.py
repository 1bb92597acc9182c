"""Finds the four pupil images of a pyramid, the valid pixels and the references on mean frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import limit_to_one_thread
from escape_hw.api.pyramid import IMAGES, PyramidPupils, pupil_boxes, remove_low_orders
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.obscuration import Shadow
from escape_hw.pipeline.geometry.pupil_rims import (
    ITERATIONS,
    MAX_HARMONIC,
    estimate_roundness_error,
    fit_rims,
)
from escape_hw.pipeline.geometry.shadow_fit import fit_shadow_offset
from escape_hw.pipeline.slopes.pyramid import slopes_of_image

#: Largest distance of an image from its nominal position, in diameters.
_REACH = 0.25
#: Largest deviation of the diameter from the nominal one: relative, and in pixels, because of diffraction.
_DIAMETER_RANGE, _DIAMETER_PX = 0.03, 2.0
#: Light of an image relative to the others below which it is missing.
_MIN_LIGHT_FRACTION = 0.1
#: Light relative to the median that is compressed to one half before rims are fitted. The value for
#: telescopes is small enough to make the rim of a vignetted edge as steep as any other; on a bench, whose
#: stop is clean, compression would emphasise the light that diffraction scatters between the images.
_COMPRESSION, _COMPRESSION_VIGNETTED = 1.0, 0.25
#: Fewest lit pixels of an image.
_MIN_VALID = 12


def find_pupil_images(
    mean_frame: NDArray[np.float32],
    *,
    n_sub: int,
    nominal_px: NDArray[np.float64],
    min_flux: float,
    normalisation: str = "global",
    modulation: float = 0.0,
    references: str = "mean",
) -> PyramidPupils:
    """Find centres, diameter, valid pixels and references on a mean frame.

    The rims of the images are fitted, with a brightness that varies along each of them, because turbulence
    changes the brightness of the images but not their rims.

    Parameters
    ----------
    mean_frame
        Mean of frames in counts ``(rows, columns)``, background subtracted.
    n_sub
        Nominal diameter of an image in pixels; the real one may differ by 3 % and two pixels.
    nominal_px
        Nominal centres ``(4, 2)`` as (x, y), in the order of :data:`~escape_hw.api.pyramid.IMAGES`; the real
        ones may be a quarter of a diameter away.
    min_flux
        Least flux of a valid pixel, relative to a bright one.
    normalisation, modulation
        See :class:`~escape_hw.api.pyramid.PyramidPupils`.
    references
        ``"mean"``: the mean slopes (with a source); ``"design"``: the mean slopes without their smooth part
        (without a source; see :func:`~escape_hw.api.pyramid.remove_low_orders`).

    Raises
    ------
    CalibrationError
        Fewer than four images, an image cut by the region, another size than the design's, or too few lit
        pixels.
    """
    if references not in ("mean", "design"):
        raise ValueError(f"references is {references!r}; choose 'mean' or 'design'")
    image = np.asarray(mean_frame, dtype=np.float64)
    rough = _find_rough_centres(image, n_sub, np.asarray(nominal_px, float))
    centres, diameter = _fit_centres(image, rough, n_sub)
    _check_fit(centres, rough, diameter, n_sub, image.shape)
    corners = pupil_boxes(centres, n_sub)
    light = _summed_light(image, corners, n_sub)
    counts = float(np.percentile(light[light > 0.02 * np.percentile(light, 99)], 95))
    flux = np.maximum(light / counts, 0.0)
    # Mean position of the pupil's centre in a box.
    middle = (n_sub - 1) / 2 + (centres - corners - (n_sub - 1) / 2).mean(axis=0)
    line = np.arange(n_sub)
    inside = np.hypot(line[None, :] - middle[0], line[:, None] - middle[1]) <= min(diameter, n_sub) / 2
    valid = inside & (flux >= min_flux)
    if valid.sum() < _MIN_VALID:
        raise CalibrationError(
            f"only {int(valid.sum())} pixels of the pupil images are lit above {min_flux:.0%} of the "
            "brightest; check the beam, the camera region and sensor.min_flux"
        )
    pupils = PyramidPupils(
        centres, diameter, corners, valid, np.zeros((int(valid.sum()), 2), np.float32),
        flux.astype(np.float32), counts, normalisation=normalisation, modulation=modulation,
    )  # fmt: skip
    mean = slopes_of_image(image, pupils).reshape(2, -1).T
    if references == "design":
        mean = remove_low_orders(mean, valid, pupils.flux)
    return replace(pupils, references=mean.astype(np.float32))


def refine_pupil_images(
    means: Sequence[NDArray[np.float32]], pupils: PyramidPupils, shadow: Shadow | None = None
) -> PyramidPupils:
    """Refit centres, diameter and flux on the mean of a long run, and estimate the error of the mean centre.

    Under turbulence the rims fitted on a second of frames may be off by some tenths of a pixel. Boxes and
    mask stay the same, and with them the slopes; the centres are for the synthetic model. Contamination of
    the edge moves the rims of all four images alike, by an error that they do not show. So on a telescope the
    rims give the diameter and the relative positions only, and the shadow of the secondary mirror the mean.

    Parameters
    ----------
    means
        Means of equally many frames in counts ``(rows, columns)``, background subtracted, in order of time.
        Without a shadow their scatter is part of the error.
    shadow
        Transmission of the telescope's obscuration and vanes; ``None`` without them.
    """
    # Many small matrix products.
    with limit_to_one_thread():
        return _refine(means, pupils, shadow)


def _refine(
    means: Sequence[NDArray[np.float32]], pupils: PyramidPupils, shadow: Shadow | None
) -> PyramidPupils:
    n_sub = pupils.valid.shape[0]
    compression, order = (_COMPRESSION, 1) if shadow is None else (_COMPRESSION_VIGNETTED, MAX_HARMONIC)
    image = np.asarray(np.mean(means, axis=0), np.float64)
    centres, diameter = _fit_centres(image, pupils.centres_px, n_sub, compression, order)
    if shadow is None:
        sigma = _rim_sigma(means, image, centres, diameter, n_sub)
    else:
        offset, sigma = fit_shadow_offset(image, centres, diameter, shadow)
        centres = centres + offset
    light = _summed_light(image, pupils.corners_px, n_sub)
    flux = np.maximum(light / np.percentile(light[pupils.valid], 95), 0.0).astype(np.float32)
    return replace(pupils, centres_px=centres, diameter_px=diameter, centre_sigma_px=sigma, flux=flux)


def _rim_sigma(
    means: Sequence[NDArray[np.float32]],
    image: NDArray[np.float64],
    centres: NDArray[np.float64],
    diameter: float,
    n_sub: int,
) -> float:
    """Standard error of the mean of the centres along an axis: roundness of the rims, scatter over time."""
    compressed = _compress_bright(image, _COMPRESSION)
    variance = estimate_roundness_error(compressed, centres, diameter / 2, n_sub / 2) ** 2
    if len(means) > 1:
        parts = [_fit_centres(np.asarray(part, np.float64), centres, n_sub)[0].mean(axis=0) for part in means]
        variance += float(np.mean(np.var(parts, axis=0, ddof=1))) / len(parts)
    return float(np.sqrt(variance))


def _summed_light(image: NDArray[np.float64], corners: NDArray[np.intp], n_sub: int) -> NDArray[np.float64]:
    """Sum of the boxes of all images ``(n_sub, n_sub)``."""
    return np.asarray(np.sum([image[y : y + n_sub, x : x + n_sub] for x, y in corners], axis=0))


def _fit_centres(
    image: NDArray[np.float64],
    rough: NDArray[np.float64],
    n_sub: int,
    compression: float = _COMPRESSION,
    order: int = 1,
) -> tuple[NDArray[np.float64], float]:
    """Centres ``(4, 2)`` and common diameter of the images, from their rims."""
    compressed = _compress_bright(image, compression)
    centres, radius = fit_rims(compressed, rough, n_sub / 2, n_sub / 2)
    if order > 1:
        centres, radius = fit_rims(compressed, centres, radius, n_sub / 2, ITERATIONS // 3, order)
    # Compression enlarges the radius, which is therefore fitted to the light itself.
    _, radius = fit_rims(image, centres, radius, n_sub / 2, ITERATIONS // 3)
    return centres, 2 * radius


def _compress_bright(image: NDArray[np.float64], compression: float) -> NDArray[np.float64]:
    """Compress bright parts, so that rims are equally steep in bright and in dim light."""
    lit = image > 0.1 * np.percentile(image, 99)
    level = compression * float(np.median(image[lit])) if lit.any() else 1.0
    light = np.maximum(image, 0.0)
    return np.asarray(light / (light + level))


def _find_rough_centres(
    image: NDArray[np.float64], n_sub: int, nominal_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rough centres ``(4, 2)`` of bright disks with dark rings around them."""
    # Half a second, which a Shack-Hartmann sensor need not wait for.
    from scipy.signal import fftconvolve

    pad = n_sub
    radius, half = n_sub / 2, n_sub // 2 + 4
    line = np.arange(-half, half + 1)
    distance = np.hypot(line[:, None], line[None, :])
    disk, ring = (distance <= radius - 1).astype(float), (distance > radius + 1) & (distance < radius + 4)
    kernel = disk / disk.sum() - ring / ring.sum()
    # The square root reduces the contrast within an image.
    light = np.pad(np.sqrt(np.maximum(image, 0.0)), pad, mode="edge")
    score = fftconvolve(light, kernel, mode="same")
    centres, contrast = [], []
    reach = max(2, round(_REACH * n_sub))
    for x, y in nominal_px:
        left, top = round(x) + pad - reach, round(y) + pad - reach
        part = score[max(top, 0) : top + 2 * reach + 1, max(left, 0) : left + 2 * reach + 1]
        row, column = np.unravel_index(int(np.argmax(part)), part.shape)
        centres.append((column + max(left, 0) - pad, row + max(top, 0) - pad))
        contrast.append(float(part.max()))
    _check_light(image, n_sub, nominal_px, np.array(contrast))
    return np.array(centres, dtype=float)


def _check_light(
    image: NDArray[np.float64], n_sub: int, nominal_px: NDArray[np.float64], contrast: NDArray[np.float64]
) -> None:
    """Raise :class:`CalibrationError` unless there is an image near each of the four nominal centres."""
    rows, columns = np.indices(image.shape)
    apart = np.min([np.hypot(columns - x, rows - y) for x, y in nominal_px], axis=0) > 0.75 * n_sub
    rest = np.sqrt(np.maximum(image[apart] if apart.any() else image, 0.0))
    # The noise of the difference between the means of disk and ring is much smaller than that of a pixel.
    noise = 6 * float(rest.std()) / np.sqrt(2 * n_sub) + 1e-3 * float(rest.mean())
    if not contrast.max() > noise:
        raise CalibrationError(
            "no pupil images on the wavefront sensor, only noise or even light; "
            "check source, beam stop, exposure and sensor.pupils_px; on a faint star measure a dark frame "
            "beside it (escape dark, devices.wfs.dark_file)"
        )
    share = np.square(np.maximum(contrast, 0.0))
    missing = share < np.maximum(_MIN_LIGHT_FRACTION * np.median(share), noise**2)
    if missing.any():
        names = " and ".join(
            f"{IMAGES[k]} (near x {nominal_px[k, 0]:g}, y {nominal_px[k, 1]:g})"
            for k in np.flatnonzero(missing)
        )
        raise CalibrationError(
            f"only {4 - int(missing.sum())} of four pupil images on the wavefront sensor; missing: {names}; "
            "check the beam on the pyramid's tip, the camera region and sensor.pupils_px; on a faint star "
            "measure a dark frame beside it (escape dark, devices.wfs.dark_file)"
        )


def _check_fit(
    centres: NDArray[np.float64],
    rough: NDArray[np.float64],
    diameter: float,
    n_sub: int,
    shape: tuple[int, ...],
) -> None:
    """Raise :class:`CalibrationError` unless the images are complete, round, and of the design's size."""
    low, high = centres - diameter / 2, centres + diameter / 2
    # Half a pixel from the centre to the edge of a pixel, and another half for diffraction.
    cut = (low < -1.0).any(axis=1) | (high > np.array(shape[::-1])).any(axis=1)
    if cut.any():
        names = " and ".join(IMAGES[k] for k in np.flatnonzero(cut))
        raise CalibrationError(
            f"the camera's region of {shape[1]} x {shape[0]} pixels cuts the {names} pupil image; "
            "move the region (devices.wfs.region)"
        )
    if not abs(diameter - n_sub) <= _DIAMETER_RANGE * n_sub + _DIAMETER_PX:
        raise CalibrationError(
            f"the pupil images are {diameter:.1f} pixels across, sensor.n_sub says {n_sub}; "
            "check sensor.n_sub and the binning"
        )
    without_rim = np.hypot(*(centres - rough).T) > max(4.0, 0.1 * n_sub)
    if without_rim.any():
        names = " and ".join(IMAGES[k] for k in np.flatnonzero(without_rim))
        raise CalibrationError(
            f"the {names} pupil image has no clear rim; use more frames, or check the light on it"
        )
