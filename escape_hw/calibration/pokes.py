"""What random pokes tell: by their spectrum over time, and by how the modes share the Strehl budget."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def information_gain(
    whitener: NDArray[np.float64], response: NDArray[np.float64], alternating: float
) -> float:
    """Fisher information of alternating pokes over that of white ones of the same rms.

    Each mode informs by the power of its whitened pokes, ``integral of |H(f) W(f)|^2 S(f)``, with the
    whitening filter ``H``, the temporal response ``W`` and the pokes' spectrum ``S``, here that of a
    first-order autoregression, ``(1 - r^2) / |1 + r exp(-i f)|^2``. Where the turbulence is weak ``|H|`` is
    large.

    Parameters
    ----------
    whitener, response
        Weights by lag.
    alternating
        ``r``, as for :class:`~.poke_patterns.AlternatingPokes`.
    """
    phasor = np.exp(-1j * np.linspace(0, np.pi, 2049))
    through = np.abs(np.polyval(whitener[::-1], phasor) * np.polyval(response[::-1], phasor)) ** 2
    spectrum = (1 - alternating**2) / np.abs(1 + alternating * phasor) ** 2
    return float(np.trapezoid(through * spectrum) / np.trapezoid(through))


def equal_snr(columns: NDArray[np.float64], most: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """Amplitudes at which every mode of the matrix is measured equally well ``(n_modes,)``.

    Whitened noise is much the same in all slopes, so a mode's signal-to-noise ratio goes as its amplitude
    times the size of its column. The Strehl ratio falls with the sum of the squared amplitudes (modes of unit
    rms), which stays what ``poke`` on every mode makes it; modes that reach their limit leave their share of
    the budget to the others.

    Parameters
    ----------
    columns
        Synthetic slopes per unit of each mode ``(n_slopes, n_modes)``.
    most
        Largest amplitude of each mode ``(n_modes,)``.
    poke
        Amplitude of white pokes.
    """
    wanted = 1 / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    budget = float(np.square(np.minimum(poke, most)).sum())
    amplitude, free = np.zeros_like(most), np.ones(most.size, dtype=bool)
    for _ in range(most.size):
        left = budget - float(np.square(most[~free]).sum())
        scale = np.sqrt(max(left, 0.0) / float(np.square(wanted[free]).sum())) if free.any() else 0.0
        amplitude = np.where(free, scale * wanted, most)
        over = free & (amplitude > most)
        if not over.any():
            break
        free &= ~over
    return np.asarray(np.minimum(amplitude, most))
