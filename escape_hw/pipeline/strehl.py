"""The Strehl ratio three ways (paper, lab results): peak, transfer function, encircled energy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.api.results import Measured, StrehlEstimate
from escape_hw.errors import CalibrationError

#: Radius of the encircled energy in pixels: about the first minimum of the bench's PSF (paper).
RADIUS_PX = 3.0
#: Width of the frame around the image that holds background only, in pixels.
_BORDER = 4


def without_background(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Image minus the median of its border."""
    border = np.ones(image.shape, dtype=bool)
    border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
    return np.asarray(image - np.median(image[border]), dtype=np.float64)


def has_light(image: NDArray[np.floating]) -> bool:
    """True when something stands clearly above the scatter of the image's border."""
    border = np.ones(image.shape, dtype=bool)
    border[_BORDER:-_BORDER, _BORDER:-_BORDER] = False
    rim = image[border]
    # Of the 16,384 pixels of a dark image the brightest stands out by about four times the scatter.
    return bool(np.max(image) - np.median(rim) > 10 * np.std(rim))


def centre_of(image: NDArray[np.float64]) -> tuple[float, float]:
    """Sub-pixel position (row, column) of the peak: a parabola through it and its neighbours."""
    row, column = (int(v) for v in np.unravel_index(np.argmax(image), image.shape))
    out = []
    for axis, at in ((0, row), (1, column)):
        if not 0 < at < image.shape[axis] - 1:
            raise CalibrationError(
                "the PSF's peak lies at the edge of the science camera's region; re-centre it"
            )
        line = image[at - 1 : at + 2, column] if axis == 0 else image[row, at - 1 : at + 2]
        bend = line[0] - 2 * line[1] + line[2]
        out.append(at + (0.5 * (line[0] - line[2]) / bend if bend < 0 else 0.0))
    return out[0], out[1]


def centred(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Background-free image of unit sum, shifted so that its peak falls on the middle pixel.

    The shift is done in Fourier space: band-limited images suffer no loss.
    """
    clean = without_background(image)
    total = clean.sum()
    if not total > 0:
        raise CalibrationError("the science camera sees no light above its background")
    middle = np.array(clean.shape) // 2
    shift = middle - np.array(centre_of(ndimage.gaussian_filter(clean, 1.0)))
    moved = np.fft.ifft2(ndimage.fourier_shift(np.fft.fft2(clean), shift)).real
    return np.asarray(moved / total)


def encircled(image: NDArray[np.float64], radius_px: float = RADIUS_PX) -> float:
    """Share of a centred image's light within ``radius_px`` of its middle."""
    y, x = np.ogrid[: image.shape[0], : image.shape[1]]
    r = np.hypot(y - image.shape[0] // 2, x - image.shape[1] // 2)
    # The rim of the circle counts by the share of each pixel inside it, to first order.
    return float((image * np.clip(radius_px + 0.5 - r, 0, 1)).sum())


def ratios(
    image: NDArray[np.floating], model: NDArray[np.floating], cutoff: float | None = None
) -> NDArray[np.float64]:
    """Peak, transfer-function and encircled-energy ratios of an image to the model PSF, ``(3,)``.

    Parameters
    ----------
    image, model
        Images ``(rows, columns)`` of the same scale; backgrounds are taken out.
    cutoff
        Radius in cycles per pixel within which the transfer functions are summed; by default where
        the model's falls to 1 % of its peak.
    """
    ours, reference = centred(image), centred(model)
    otf, ideal = np.fft.fft2(np.fft.ifftshift(ours)).real, np.fft.fft2(np.fft.ifftshift(reference)).real
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(ours.shape[0]), np.fft.fftfreq(ours.shape[1]), indexing="ij"))
    inside = f <= cutoff if cutoff else ideal > 0.01 * ideal.max()
    middle = tuple(n // 2 for n in ours.shape)
    return np.array(
        [
            ours[middle] / reference[middle],
            otf[inside].sum() / ideal[inside].sum(),
            encircled(ours) / encircled(reference),
        ]
    )


def strehl(frames: NDArray[np.floating], model: NDArray[np.floating], batches: int = 8) -> StrehlEstimate:
    """Strehl ratios of a stack of frames, with standard errors.

    The value is that of the mean of all frames; the error comes from the scatter of the means of
    successive batches, long enough to be nearly independent.

    Parameters
    ----------
    frames
        Science frames ``(n, rows, columns)``.
    model
        Model PSF, taken without turbulence.
    batches
        How many batches; fewer when there are few frames.

    Raises
    ------
    CalibrationError
        No frames, no light, or the peak at the edge.
    """
    if len(frames) == 0:
        raise CalibrationError("no science frames to take a Strehl ratio from; run the loop for longer")
    values = ratios(frames.mean(axis=0), model)
    n = min(batches, len(frames))
    if n < 2:
        errors = np.full(3, np.nan)
    else:
        parts = np.array([ratios(part.mean(axis=0), model) for part in np.array_split(frames, n)])
        errors = parts.std(axis=0, ddof=1) / np.sqrt(n)
    return StrehlEstimate(*(Measured(float(v), float(e)) for v, e in zip(values, errors, strict=True)))
