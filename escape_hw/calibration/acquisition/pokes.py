"""Poke sequences (random, anticorrelated, push-pull), their amplitudes and their cost in Strehl ratio."""

from __future__ import annotations

import abc
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.bench import Bench
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.config.choices import PokePattern
from escape_hw.config.renamed import present_value
from escape_hw.errors import ConfigError

#: Correlation, with opposite sign, of an anticorrelated poke with the one before. Beyond this the Fisher
#: information of the whitened pokes grows little, and the mirror has to make ever larger steps.
ANTICORRELATION = 0.6
#: Frequencies of the sum in :func:`noise_gain`.
_FREQUENCIES = 2048


class PokeSequence(abc.ABC):
    """Sequence of pokes.

    ``amplitude``: limit of the absolute poke of each mode ``(n_modes,)``; ``rng``: random generator.

    Attributes
    ----------
    method, title
        Name of a measurement with these pokes in products, and in reports.
    """

    method: ClassVar[str]
    title: ClassVar[str]

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._amplitude, self._rng = amplitude, rng

    @abc.abstractmethod
    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""


class RandomPokes(PokeSequence):
    """Pokes on all modes in every frame, uniform and independent (DO-CRIME; Lai et al. 2020)."""

    method, title = "docrime", "DO-CRIME"

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        return self._amplitude * self._rng.uniform(-1.0, 1.0, self._amplitude.size)


class AnticorrelatedPokes(RandomPokes):
    """Random pokes whose power lies at high frequencies, where turbulence is weak.

    The correlation of each poke with the one before is minus :data:`ANTICORRELATION` (first-order
    autoregression of the same rms). Modes are independent of each other and of the turbulence.
    """

    _last: NDArray[np.float64] | None = None

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        poke = super().__call__()
        if self._last is not None:
            poke = np.sqrt(1 - ANTICORRELATION**2) * poke - ANTICORRELATION * self._last
        self._last = poke
        return poke


def select_random_pokes(kind: PokePattern) -> type[PokeSequence]:
    """Class of the random pokes for a value of ``calibration.pokes``."""
    kind = present_value("calibration.pokes", kind)
    return AnticorrelatedPokes if kind == "anticorrelated" else RandomPokes


class PushPullPokes(PokeSequence):
    """Fast push-pull: one mode at a time, pushed and pulled in consecutive frames.

    Neither frame waits for the mirror to settle or for the turbulence to average out; the estimator assigns
    slopes to pokes, as with random pokes. The order of the modes and of push and pull is drawn anew in every
    round, so that turbulence does not affect the same mode each time.
    """

    method, title = "push-pull-fast", "fast push-pull"

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        super().__init__(amplitude, rng)
        self._queue: list[tuple[int, float]] = []
        self._poke = np.zeros(amplitude.size)

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        if not self._queue:
            for mode in self._rng.permutation(self._amplitude.size):
                sign = float(self._rng.choice((-1.0, 1.0)))
                self._queue += [(int(mode), sign), (int(mode), -sign)]
            self._queue.reverse()
        mode, sign = self._queue.pop()
        self._poke[:] = 0.0
        self._poke[mode] = sign * self._amplitude[mode]
        return self._poke


def compute_poke_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """Amplitude of each mode's poke ``(n_modes,)``, rms surface as fraction of full stroke.

    Modes that need large commands, such as those at the pupil's rim, are poked less, so that no single mode
    takes more than ``calibration.poke_command`` of any actuator.

    Raises
    ------
    ConfigError
        The poke is not in (0, 1].
    """
    if not 0 < poke <= 1:
        raise ConfigError(f"poke is {poke}; it must lie in (0, 1], rms surface as fraction of full stroke")
    return np.asarray(np.minimum(poke, _max_amplitudes(bench, m2c)))


def note_limited_poke(bench: Bench, amplitude: NDArray[np.float64], poke: float) -> list[str]:
    """Note for the operator if no mode is poked with the ``poke`` that was requested."""
    largest = float(amplitude.max())
    if largest >= poke:
        return []
    command = bench.config.calibration.poke_command
    return [
        f"no mode was poked with {poke:g}, {largest:.3g} at most: calibration.poke_command, {command:g}, "
        "limits them all; raise it for larger pokes"
    ]


def compute_random_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """Amplitude of each mode ``(n_modes,)`` for random pokes on all modes at once.

    As :func:`compute_poke_amplitudes`, unless ``calibration.pokes`` is ``"equal-snr"``: the modes then share
    the same Strehl loss such that all are measured equally well (:func:`equal_snr_amplitudes`).
    """
    amplitudes = compute_poke_amplitudes(bench, m2c, poke)
    if bench.config.calibration.pokes != "equal-snr":
        return amplitudes
    columns = modal_matrix(bench.model(), Registration(), m2c)
    return equal_snr_amplitudes(columns, _max_amplitudes(bench, m2c), poke)


def _max_amplitudes(bench: Bench, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of each mode at which an actuator takes ``calibration.poke_command``."""
    return np.asarray(bench.config.calibration.poke_command / np.abs(m2c).max(axis=0))


def equal_snr_amplitudes(
    columns: NDArray[np.float64], max_amplitude: NDArray[np.float64], poke: float
) -> NDArray[np.float64]:
    """Amplitudes ``(n_modes,)`` at which every mode of the matrix is measured equally well.

    Whitened noise is similar in all slopes, so the signal-to-noise ratio of a mode is proportional to its
    amplitude times the norm of its column. The Strehl loss depends on the sum of the squared amplitudes,
    which stays that of ``poke`` on every mode. Modes that reach their maximum leave the rest of their share
    to the others.

    Parameters
    ----------
    columns
        Synthetic slopes per unit of each mode ``(n_slopes, n_modes)``.
    max_amplitude
        Largest amplitude of each mode ``(n_modes,)``.
    poke
        Amplitude of equal pokes with the same Strehl loss.
    """
    relative_amplitude = 1 / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    budget = float(np.square(np.minimum(poke, max_amplitude)).sum())
    amplitude, free = np.zeros_like(max_amplitude), np.ones(max_amplitude.size, dtype=bool)
    for _ in range(max_amplitude.size):
        remaining = max(budget - float(np.square(max_amplitude[~free]).sum()), 0.0)
        power = float(np.square(relative_amplitude[free]).sum())
        scale = np.sqrt(remaining / power) if free.any() else 0.0
        amplitude = np.where(free, scale * relative_amplitude, max_amplitude)
        over = free & (amplitude > max_amplitude)
        if not over.any():
            break
        free &= ~over
    return np.asarray(np.minimum(amplitude, max_amplitude))


def noise_gain(gain: float, leak: float, delay_frames: float) -> float:
    """Factor by which a leaky integrator raises the variance of white pokes added to its command.

    Mean over frequency of ``|1 / (1 + g z^-d / (1 - (1 - l) z^-1))|^2``: the loop measures the pokes like
    turbulence and corrects them with its delay.

    ``gain``, ``leak``: effective gain of the loop, and leak; ``delay_frames``: frames from a command to the
    slopes that show it.
    """
    phasor = np.exp(-2j * np.pi * (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES))
    denominator = 1 - (1 - leak) * phasor
    return float(np.mean(np.abs(denominator / (denominator + gain * phasor**delay_frames)) ** 2))


def strehl_loss(
    amplitude: NDArray[np.float64], stroke_m: float, wavelength_m: float, loop_noise_gain: float = 1.0
) -> float:
    """Relative loss of the Strehl ratio by uniform pokes, ``1 - exp(-(2 pi sigma / lambda)^2)``.

    Parameters
    ----------
    amplitude
        Limit of the absolute poke of each mode ``(n_modes,)``, rms surface as fraction of full stroke. The
        modes are nearly orthogonal, so their variances add.
    stroke_m, wavelength_m
        Full stroke and wavelength in metres.
    loop_noise_gain
        Factor of the loop on the variance of the pokes, from :func:`noise_gain`.
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
    """Scale amplitudes down by a common factor until :func:`strehl_loss` is at most ``budget``."""
    exponent = -np.log1p(-strehl_loss(amplitude, stroke_m, wavelength_m, loop_noise_gain))
    allowed = -np.log1p(-budget)
    return np.asarray(amplitude * min(1.0, np.sqrt(allowed / exponent)) if exponent > 0 else amplitude)
