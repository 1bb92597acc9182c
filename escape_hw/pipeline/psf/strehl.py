"""Diffraction image of a pupil, and Strehl ratios by peak, optical transfer function, encircled energy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.api.camera import Frame
from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.statistics import standard_error

#: Radius of the encircled energy in pixels: about the first minimum of the bench's PSF (paper).
RADIUS_PX = 3.0
#: Width of the border of an image that contains background only, in pixels.
_BORDER_PX = 4


def diffraction_psf(
    pupil: NDArray[np.bool_], samples_across: float, psf_px: float, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Diffraction image of a pupil, by a matrix Fourier transform (Soummer et al. 2007).

    Returns an image of unit sum over an infinite camera, with its peak on the middle pixel.

    Parameters
    ----------
    pupil
        Mask of the transmitted light ``(n, n)``.
    samples_across
        Samples across the diameter D of the pupil.
    psf_px
        lambda/D in camera pixels.
    shape
        Camera region (rows, columns).
    """
    n = pupil.shape[0]
    places = (np.arange(n) - (n - 1) / 2) / samples_across
    left, right = (np.exp(-2j * np.pi * np.outer(np.arange(m) - m // 2, places) / psf_px) for m in shape)
    field = left @ pupil.astype(float) @ right.T
    power = pupil.sum() * (samples_across * psf_px) ** 2
    return np.asarray(np.abs(field) ** 2 / power, dtype=np.float32)


def subtract_background(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Image ``(rows, columns)`` minus the median of its border."""
    return np.asarray(image - np.median(image[_border_mask(image.shape)]), dtype=np.float64)


def _border_mask(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask of the border of an image."""
    border = np.ones(shape, dtype=bool)
    border[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    return border


def has_light(image: NDArray[np.floating]) -> bool:
    """Whether the brightest pixel of an image ``(rows, columns)`` exceeds the median of its border.

    By more than ten times the scatter of the border.
    """
    rim = image[_border_mask(image.shape)]
    # The brightest of the 16,384 pixels of a dark image exceeds it by about four times the scatter.
    return bool(np.max(image) - np.median(rim) > 10 * np.std(rim))


def is_peak_saturated(frame: Frame) -> bool:
    """Whether pixels within :data:`RADIUS_PX` of the peak of a frame are saturated.

    A saturated peak biases all Strehl ratios; a hot pixel elsewhere does not.
    """
    if not frame.n_saturated:
        return False
    # Smoothed, so that a single hot pixel is not taken for the peak.
    smooth = ndimage.gaussian_filter(frame.data.astype(np.float32), 1.0)
    row, column = np.unravel_index(np.argmax(smooth), smooth.shape)
    y, x = np.ogrid[: frame.data.shape[0], : frame.data.shape[1]]
    near = np.hypot(y - row, x - column) <= RADIUS_PX
    top = frame.data.max()
    # At least two: neighbours of a clipped peak are nearly as bright.
    return bool(np.count_nonzero(frame.data[near] == top) > 1)


def find_peak(image: NDArray[np.float64]) -> tuple[float, float]:
    """Sub-pixel position (row, column) of the peak, by a parabola through it and its neighbours."""
    row, column = (int(v) for v in np.unravel_index(np.argmax(image), image.shape))
    out = []
    for axis, at in ((0, row), (1, column)):
        if not 0 < at < image.shape[axis] - 1:
            raise CalibrationError(
                "the PSF's peak lies at the edge of the science camera's region; re-centre it"
            )
        line = image[at - 1 : at + 2, column] if axis == 0 else image[row, at - 1 : at + 2]
        curvature = line[0] - 2 * line[1] + line[2]
        out.append(at + (0.5 * (line[0] - line[2]) / curvature if curvature < 0 else 0.0))
    return out[0], out[1]


def centre_image(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Image of unit sum without background, shifted (in Fourier space) to have its peak in the middle."""
    clean = subtract_background(image)
    total = clean.sum()
    if not total > 0:
        raise CalibrationError(
            "the science camera sees no light above its background; check the source and the region"
        )
    return np.asarray(_shift_image(clean, _shift_to_centre(clean)) / total)


def _shift_to_centre(clean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift (rows, columns) from an image's peak to the middle pixel."""
    peak = find_peak(ndimage.gaussian_filter(clean, 1.0))
    return np.asarray(np.array(clean.shape) // 2 - np.array(peak))


def _shift_image(image: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.fft.ifft2(ndimage.fourier_shift(np.fft.fft2(image), shift)).real)


def compute_encircled_energy(image: NDArray[np.float64], radius_px: float = RADIUS_PX) -> float:
    """Light within ``radius_px`` pixels of the middle of a centred image ``(rows, columns)`` of unit sum."""
    return float((image * _aperture(image.shape, radius_px)).sum())


def _aperture(shape: tuple[int, ...], radius_px: float) -> NDArray[np.float64]:
    """Mask of a circle about the middle, with the covered fraction of each pixel to first order."""
    y, x = np.ogrid[: shape[0], : shape[1]]
    return np.asarray(np.clip(radius_px + 0.5 - np.hypot(y - shape[0] // 2, x - shape[1] // 2), 0, 1))


def strehl_ratios(image: NDArray[np.floating], model: NDArray[np.floating]) -> NDArray[np.float64]:
    """Peak, transfer-function and encircled-energy ratios of an image to the model PSF, ``(3,)``.

    ``image``, ``model``: images ``(rows, columns)`` of the same scale; backgrounds are subtracted.
    """
    weights = _ratio_weights(centre_image(model))
    return np.asarray(weights @ centre_image(image).ravel())


def _ratio_weights(model: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights ``(3, n_pixels)`` whose products with a centred image of unit sum are the three ratios.

    The transfer functions are summed where the model's exceeds 1 % of its peak.
    """
    ideal = np.fft.fft2(np.fft.ifftshift(model)).real
    inside = ideal > 0.01 * ideal.max()
    peak = np.zeros(model.shape)
    middle = tuple(n // 2 for n in model.shape)
    peak[middle] = 1 / model[middle]
    # A sum of a transfer function over frequencies is a weighted sum over the image.
    otf = np.fft.fftshift(np.fft.fft2(inside.astype(float)).real) / ideal[inside].sum()
    circle = _aperture(model.shape, RADIUS_PX) / compute_encircled_energy(model)
    return np.stack([peak, otf, circle]).reshape(3, -1)


def strehl(frames: NDArray[np.floating], model: NDArray[np.floating]) -> StrehlEstimate:
    """Strehl ratios of a stack of frames, with standard errors.

    The value is that of the mean of all frames. Each ratio is a weighted sum over that image divided by its
    light, so the contribution of every frame is known, and the error is that of the mean of the contributions
    (see :func:`~escape_hw.pipeline.statistics.standard_error`). It does not include the error of the model
    PSF.

    ``frames``: science frames in order ``(n, rows, columns)``; ``model``: model PSF, taken without
    turbulence.

    Errors are NaN for fewer than :data:`~escape_hw.pipeline.statistics.MIN_SAMPLES` frames.

    Raises
    ------
    CalibrationError
        There are no frames, no light, or the peak is at the edge.
    """
    if len(frames) == 0:
        raise CalibrationError("no science frames to take a Strehl ratio from; run the loop for longer")
    mean = frames.mean(axis=0)
    values = strehl_ratios(mean, model)
    # The weights are shifted onto the image instead of all frames onto the middle.
    shift_back = -_shift_to_centre(subtract_background(mean))
    weights = np.stack(
        [_shift_image(w.reshape(mean.shape), shift_back).ravel() for w in _ratio_weights(centre_image(model))]
    )
    weights = np.concatenate([weights, np.ones((1, mean.size))])
    rim = _border_mask(mean.shape)
    rims = frames[:, rim].mean(axis=1, dtype=np.float64)
    # The background of each frame varies, too, and with it the light of the whole image.
    dark = float(np.median(mean[rim])) + rims - rims.mean()
    sums = frames.reshape(len(frames), -1) @ weights.T.astype(np.float32)
    sums = sums - np.outer(dark, weights.sum(axis=1))
    light = sums[:, 3:].mean()
    shares = (sums[:, :3] - values * sums[:, 3:]) / light
    errors = [standard_error(share) for share in shares.T]
    return StrehlEstimate(*(Estimate(float(v), e) for v, e in zip(values, errors, strict=True)))
