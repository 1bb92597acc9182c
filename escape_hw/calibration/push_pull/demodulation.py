"""Lock-in detection of several sinusoidally driven modes at once (Esposito et al. 2006; Pinna et al. 2012).

A mode driven as ``a sin(w t)`` changes slope s as ``a D_s Re[-i H(w) exp(i w t)]``, where ``H`` is the common
temporal response. Slopes and sinusoids are differenced from frame to frame first, because the power of
turbulence decreases so steeply with frequency that it would leak into every line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import TooFewFrames

#: Distances from a line, in frequency bins, at which its noise is measured.
_NOISE_BINS = (-2, -1, 1, 2)
#: Distance between lines in frequency bins.
LINE_SPACING_BINS = 4
#: Step of the delay search in frames.
_DELAY_STEP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SpectralLines:
    """Complex amplitudes of the slopes at the frequencies of the driven modes.

    Parameters
    ----------
    amplitude
        ``(n_slopes, n_modes)``: ``D H(w)`` for each mode, in slopes per unit mode.
    sigma
        Standard error of the real and of the imaginary part, same shape.
    frequency
        Angular frequency of each mode in radians per frame ``(n_modes,)``.
    """

    amplitude: NDArray[np.complex128]
    sigma: NDArray[np.float64]
    frequency: NDArray[np.float64]


def choose_line_frequencies(n_modes: int, frames: int, band: tuple[float, float]) -> NDArray[np.float64]:
    """Choose angular frequencies for the modes of a batch.

    ``band``: lowest and highest frequency in cycles per frame.

    Returns
    -------
    ndarray, ``(n,)``
        In radians per frame, spread over the band, each a whole number of cycles per batch; ``n`` is
        ``n_modes`` or the number of lines that fit.

    Raises
    ------
    TooFewFrames
        No line fits.
    """
    low, high = int(np.ceil(band[0] * frames)), int(np.floor(band[1] * frames))
    n_fitting = (high - low) // LINE_SPACING_BINS + 1
    if n_fitting < 1 or low < LINE_SPACING_BINS:
        raise TooFewFrames(
            f"{frames} frames per batch resolve no line between {band[0]:g} and {band[1]:g} cycles per "
            "frame; use more frames"
        )
    n = min(n_modes, n_fitting)
    bins = low + np.rint(np.linspace(0, high - low, n) if n > 1 else np.zeros(1))
    return np.asarray(2 * np.pi * bins / frames)


def fit_lines(
    time: NDArray[np.int64],
    slopes: NDArray[np.floating],
    frequency: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    frames: int,
) -> SpectralLines:
    """Fit the amplitudes of all lines by least squares on the frames received.

    Parameters
    ----------
    time
        Frame indices ``(n,)``, increasing; the modes were driven as ``amplitude sin(frequency time)``.
    slopes
        ``(n, n_slopes)``.
    frequency, amplitude
        Frequencies in radians per frame, and amplitudes of the modes ``(n_modes,)``.
    frames
        Frames of the batch, which give the width of a frequency bin.

    Raises
    ------
    TooFewFrames
        Too few consecutive frames for the number of lines.
    """
    pairs = np.flatnonzero(np.diff(time) == 1)
    lines = frequency.size
    if pairs.size < 2 * lines + 2 * len(_NOISE_BINS):
        raise TooFewFrames(
            f"{pairs.size} pairs of consecutive frames are too few for {lines} lines; use more frames"
        )
    y = np.asarray(slopes[pairs + 1] - slopes[pairs], dtype=np.float64)
    sinusoids = np.exp(1j * np.outer(time, frequency)) * amplitude
    steps = sinusoids[pairs + 1] - sinusoids[pairs]
    # s = Re(-i Z exp(i w t)) = Re(Z) sin(w t) - Im(Z) (-cos(w t)), with Z = D H.
    design = np.concatenate([steps.imag, steps.real], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, y, rcond=None)
    residuals = y - design @ coefficients
    amplitudes = (coefficients[:lines] + 1j * coefficients[lines:]).T
    noise_frequencies = np.stack([frequency + k * 2 * np.pi / frames for k in _NOISE_BINS], axis=1)
    power = np.empty((y.shape[1], lines))
    for mode in range(lines):
        probe = np.exp(-1j * np.outer(noise_frequencies[mode], time[pairs + 1]))
        power[:, mode] = np.mean(np.abs(probe @ residuals) ** 2, axis=0) / pairs.size
    # The residuals lack the degrees of freedom of the lines.
    power *= pairs.size / (pairs.size - 2 * lines)
    # Four bins are few for one slope at one line; the spectra of all slopes are assumed to have one shape.
    power = np.outer(power.mean(axis=1), power.mean(axis=0)) / max(float(power.mean()), 1e-300)
    differenced = np.abs(1 - np.exp(-1j * frequency)) * np.abs(amplitude)
    return SpectralLines(amplitudes, np.sqrt(2 * power / pairs.size) / differenced, frequency)


def frequency_response(frequency: NDArray[np.float64], delay: float) -> NDArray[np.complex128]:
    """Response ``H`` of a mirror that holds each command for a frame, after a delay in frames.

    With a fractional delay, a command acts partly in one frame and partly in the next.
    """
    whole_frames = np.floor(delay)
    share = delay - whole_frames
    return np.asarray(np.exp(-1j * frequency * whole_frames) * (1 - share + share * np.exp(-1j * frequency)))


def estimate_delay(lines: SpectralLines, max_delay: float) -> tuple[float, float]:
    """Delay that rotates all lines onto the real axis, and its standard error, in frames.

    ``sum_s Z_s^2`` has twice the phase of ``H`` for any signs of ``D``. Lines at several frequencies make the
    delay unambiguous.

    ``max_delay``: largest delay of the search in frames.
    """
    weight = 1 / np.mean(np.square(lines.sigma), axis=0)
    square = np.sum(lines.amplitude**2, axis=0) * weight
    delays = np.arange(0.0, max_delay + _DELAY_STEP / 2, _DELAY_STEP)
    responses = np.array([frequency_response(lines.frequency, d) for d in delays])
    agreement = (square * np.exp(-2j * np.angle(responses))).real.sum(axis=1)
    best = int(np.argmax(agreement))
    # Curvature of the log-likelihood, of which the sum of squares is half the agreement.
    slope = np.gradient(np.unwrap(np.angle(responses), axis=0), delays, axis=0)[best]
    information = float(np.sum(np.abs(square) * slope**2))
    return float(delays[best]), float(1 / np.sqrt(max(information, 1e-300)))


def compute_matrix(lines: SpectralLines, delay: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Interaction matrix and standard errors ``(n_slopes, n_modes)``, divided by the temporal response."""
    response = frequency_response(lines.frequency, delay)
    return (lines.amplitude / response).real, lines.sigma / np.abs(response)
