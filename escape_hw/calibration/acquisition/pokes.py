"""Poke sequences (random, anticorrelated, push-pull), their amplitudes, their information content and their cost in Strehl ratio."""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.choices import PokePattern
from escape_hw.config.renamed import present_value

#: How strongly shaped pokes alternate in sign. More gains little (:func:`~.pokes.information_gain`) and asks
#: the mirror for ever larger steps.
ANTICORRELATION = 0.6


class PokeSequence(Protocol):
    """Makes pokes from the amplitude of each mode ``(n_modes,)`` and a random generator.

    Attributes
    ----------
    method, title
        What a measurement with these pokes is called, in products and to people.
    """

    method: ClassVar[str]
    title: ClassVar[str]

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None: ...

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        ...


class RandomPokes:
    """Every mode in every frame, uniform and independent (DO-CRIME; Lai et al. 2020).

    Parameters
    ----------
    amplitude
        Pokes of each mode lie within plus and minus this ``(n_modes,)``.
    rng
        Where they come from.
    """

    method: ClassVar[str] = "docrime"
    title: ClassVar[str] = "DO-CRIME"

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._amplitude, self._rng = amplitude, rng

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        return self._amplitude * self._rng.uniform(-1.0, 1.0, self._amplitude.size)


class AnticorrelatedPokes(RandomPokes):
    """As :class:`RandomPokes`, with signs that change more often than not: where turbulence is weak.

    Each poke is correlated with the one before by minus :data:`ANTICORRELATION`, a first-order
    autoregression of the same rms; the modes stay independent of each other and of the turbulence.
    """

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        super().__init__(amplitude, rng)
        self._last: NDArray[np.float64] | None = None

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        poke = super().__call__()
        if self._last is not None:
            poke = np.sqrt(1 - ANTICORRELATION**2) * poke - ANTICORRELATION * self._last
        self._last = poke
        return poke


def select_random_pokes(kind: PokePattern) -> type[PokeSequence]:
    """The random pokes that the configuration asks for (``calibration.pokes``)."""
    kind = present_value("calibration.pokes", kind)
    return AnticorrelatedPokes if kind == "anticorrelated" else RandomPokes


class PushPullPokes:
    """One mode at a time, pushed and pulled from frame to frame, the modes in a new order every round.

    Fast push-pull: neither frame waits for the mirror to settle or for the turbulence to average out;
    which slopes belong to which poke is a matter of the estimator, as with random pokes. The random
    order keeps what the turbulence does in one round from meeting the same mode in the next.

    Parameters
    ----------
    amplitude
        Push and pull of each mode ``(n_modes,)``.
    rng
        Decides the order.
    """

    method: ClassVar[str] = "push-pull-fast"
    title: ClassVar[str] = "fast push-pull"

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._amplitude, self._rng = amplitude, rng
        self._queue: list[tuple[int, float]] = []
        self._poke = np.zeros(amplitude.size)

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        if not self._queue:
            for mode in self._rng.permutation(self._amplitude.size):
                # Which comes first is drawn, too: the sign of a poke tells nothing of the one before.
                sign = float(self._rng.choice((-1.0, 1.0)))
                self._queue += [(int(mode), sign), (int(mode), -sign)]
            self._queue.reverse()
        mode, sign = self._queue.pop()
        self._poke[:] = 0.0
        self._poke[mode] = sign * self._amplitude[mode]
        return self._poke


def information_gain(
    whitener: NDArray[np.float64], response: NDArray[np.float64], anticorrelation: float
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
        ``r``, as for :class:`~.poke_patterns.AnticorrelatedPokes`.
    """
    phasor = np.exp(-1j * np.linspace(0, np.pi, 2049))
    filtered_power = np.abs(np.polyval(whitener[::-1], phasor) * np.polyval(response[::-1], phasor)) ** 2
    spectrum = (1 - anticorrelation**2) / np.abs(1 + anticorrelation * phasor) ** 2
    return float(np.trapezoid(filtered_power * spectrum) / np.trapezoid(filtered_power))


def equal_snr_amplitudes(
    columns: NDArray[np.float64], max_amplitude: NDArray[np.float64], poke: float
) -> NDArray[np.float64]:
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
    relative_amplitude = 1 / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    budget = float(np.square(np.minimum(poke, max_amplitude)).sum())
    amplitude, free = np.zeros_like(max_amplitude), np.ones(max_amplitude.size, dtype=bool)
    for _ in range(max_amplitude.size):
        remaining = budget - float(np.square(max_amplitude[~free]).sum())
        scale = (
            np.sqrt(max(remaining, 0.0) / float(np.square(relative_amplitude[free]).sum()))
            if free.any()
            else 0.0
        )
        amplitude = np.where(free, scale * relative_amplitude, max_amplitude)
        over = free & (amplitude > max_amplitude)
        if not over.any():
            break
        free &= ~over
    return np.asarray(np.minimum(amplitude, max_amplitude))


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
    delay_phasor = np.exp(-2j * np.pi * (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES))
    leak_denominator = 1 - (1 - leak) * delay_phasor
    return float(
        np.mean(np.abs(leak_denominator / (leak_denominator + gain * delay_phasor**delay_frames)) ** 2)
    )


def strehl_loss(
    amplitude: NDArray[np.float64], stroke_m: float, wavelength_m: float, loop_noise_gain: float = 1.0
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
    variance = loop_noise_gain * float(np.square(2 * stroke_m * amplitude).sum()) / 3
    return float(-np.expm1(-variance * (2 * np.pi / wavelength_m) ** 2))


def scale_to_strehl_budget(
    amplitude: NDArray[np.float64],
    budget: float,
    stroke_m: float,
    wavelength_m: float,
    loop_noise_gain: float = 1.0,
) -> NDArray[np.float64]:
    """The amplitudes, lowered alike until they cost no more than ``budget`` of the Strehl ratio."""
    exponent = -np.log1p(-strehl_loss(amplitude, stroke_m, wavelength_m, loop_noise_gain))
    allowed = -np.log1p(-budget)
    return np.asarray(amplitude * min(1.0, np.sqrt(allowed / exponent)) if exponent > 0 else amplitude)
