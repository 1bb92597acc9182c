"""What pokes cost the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Frequencies that the loop's answer is summed over.
_FREQUENCIES = 2048


def noise_gain(gain: float, leak: float, delay_frames: float) -> float:
    """Factor by which a leaky integrator raises the variance of white pokes added behind it.

    Mean over frequency of ``|1 / (1 + g z^-d / (1 - (1 - l) z^-1))|^2``: the loop takes the pokes for
    turbulence and answers them, too late.

    Parameters
    ----------
    gain, leak
        Effective gain of the loop and leak.
    delay_frames
        Frames from a command to the slopes that show it.
    """
    late = np.exp(-2j * np.pi * (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES))
    held = 1 - (1 - leak) * late
    return float(np.mean(np.abs(held / (held + gain * late**delay_frames)) ** 2))


def strehl_loss(
    amplitude: NDArray[np.float64], stroke_m: float, wavelength_m: float, raised: float = 1.0
) -> float:
    """Share of the Strehl ratio that uniform pokes cost, ``1 - exp(-(2 pi sigma / lambda)^2)``.

    Parameters
    ----------
    amplitude
        Pokes of each mode lie within plus and minus this ``(n_modes,)``, rms surface as fraction of full
        stroke; the modes are nearly orthogonal, so their variances add.
    stroke_m, wavelength_m
        Full stroke and wavelength in metres.
    raised
        Factor of the loop on their variance, :func:`noise_gain`.
    """
    variance = raised * float(np.square(2 * stroke_m * amplitude).sum()) / 3
    return float(-np.expm1(-variance * (2 * np.pi / wavelength_m) ** 2))


def within_budget(
    amplitude: NDArray[np.float64], budget: float, stroke_m: float, wavelength_m: float, raised: float = 1.0
) -> NDArray[np.float64]:
    """The amplitudes, lowered alike until they cost no more than ``budget`` of the Strehl ratio."""
    exponent = -np.log1p(-strehl_loss(amplitude, stroke_m, wavelength_m, raised))
    allowed = -np.log1p(-budget)
    return np.asarray(amplitude * min(1.0, np.sqrt(allowed / exponent)) if exponent > 0 else amplitude)
