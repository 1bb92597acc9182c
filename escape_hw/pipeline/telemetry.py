"""Analysis of closed-loop telemetry: spectra, rejection, gain per mode, suspicious elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.pipeline.control.integrator import gain_limit
from escape_hw.pipeline.statistics import NORMAL_RATIO

#: Shortest and longest segment of a spectrum in frames, and number of segments (without overlap) to aim at.
_MIN_SEGMENT, _MAX_SEGMENT, _N_SEGMENTS = 64, 4096, 4
#: Largest share of lost frames that is interpolated.
_MAX_LOST = 0.1
#: Trial gains of each mode, and gain margin of the largest.
_N_GAINS, _GAIN_MARGIN = 60, 2.0
#: Robust standard deviations from the median from which an element is suspicious, and least relative scatter
#: that is assumed.
_OUTLIER_SIGMA, _MIN_SCATTER = 5.0, 0.2
#: Share of the median rms below which an element does not move, share of the stroke that counts as its limit,
#: and share of frames at the limit from which an actuator is suspicious.
_STILL, _AT_LIMIT, _LIMIT_SHARE = 0.02, 0.98, 0.05


def fill_lost_frames(
    index: NDArray[np.integer], data: NDArray[np.floating]
) -> tuple[NDArray[np.float32], int]:
    """Data of consecutive frames ``(n, k)`` with lost frames interpolated, and the number of these.

    ``index``: frame numbers ``(m,)``, rising; ``data``: ``(m, k)``.

    Raises
    ------
    ValueError
        Fewer than :data:`_MIN_SEGMENT` frames, or too many lost ones.
    """
    if len(index) < _MIN_SEGMENT:
        raise ValueError(f"{len(index)} frames are too few for a spectrum; record at least {_MIN_SEGMENT}")
    present = np.asarray(index, np.int64) - int(index[0])
    n = int(present[-1]) + 1
    lost = n - len(present)
    if lost > _MAX_LOST * n or np.any(np.diff(present) <= 0):
        raise ValueError(
            f"{lost} of {n} frames are missing; a spectrum needs {1 - _MAX_LOST:.0%} of them in their order"
        )
    values = np.asarray(data, np.float32)
    if not lost:
        return values, 0
    every = np.arange(n)
    after = np.clip(np.searchsorted(present, every), 1, len(present) - 1)
    before = after - 1
    share = ((every - present[before]) / (present[after] - present[before])).astype(np.float32)[:, None]
    return values[before] + share * (values[after] - values[before]), lost


def power_spectra(
    data: NDArray[np.floating], rate_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One-sided power spectral densities by Welch's method (Welch 1967): Hann window, half overlap.

    Parameters
    ----------
    data
        Consecutive frames ``(n, k)``.
    rate_hz
        Frames per second.

    Returns
    -------
    frequency_hz : ndarray, ``(n_frequencies,)``
        Without zero.
    density : ndarray, ``(n_frequencies, k)``
        Unit of the data squared per hertz.
    """
    longest = max(len(data) // _N_SEGMENTS, _MIN_SEGMENT)
    segment = min(2 ** int(np.log2(longest)), _MAX_SEGMENT, len(data))
    # Here: its import takes as long as half a short command, and only the analysis of recordings needs it.
    from scipy import signal

    frequency, density = signal.welch(data, rate_hz, nperseg=segment, axis=0)
    return np.asarray(frequency[1:], float), np.asarray(density[1:], float)


def rejection(
    frequency_hz: NDArray[np.floating],
    rate_hz: float,
    gain: float | NDArray[np.floating],
    leak: float,
    delay_frames: float,
) -> NDArray[np.float64]:
    """Squared modulus of the rejection transfer function of the leaky integrator.

    ``1 / (1 + L)`` with ``L = g z^-d / (1 - (1 - leak) z^-1)`` and ``z = exp(2 pi i f / rate)``, from
    ``c[k] = (1 - leak) c[k-1] - g s[k]`` and ``s[k] = phi[k] + c[k-d]``. ``gain`` is broadcast against
    ``frequency_hz``.
    """
    z = np.exp(2j * np.pi * np.asarray(frequency_hz, float) / rate_hz)
    loop = gain * z ** (-delay_frames) / (1 - (1 - leak) / z)
    return np.asarray(np.square(np.abs(1 / (1 + loop))))


def largest_gain(delay_frames: float) -> float:
    """Largest gain of an integrator with a gain margin of 2."""
    return gain_limit(delay_frames) / _GAIN_MARGIN


def optimal_gains(
    frequency_hz: NDArray[np.floating],
    density: NDArray[np.floating],
    rate_hz: float,
    leak: float,
    delay_frames: float,
) -> NDArray[np.float64]:
    """Gain of each mode ``(n_modes,)`` with the smallest residual, with a gain margin of at least 2.

    Minimises the integral of rejection times the (pseudo) open-loop spectrum, noise included (Gendron & Léna
    1994, A&A 291, 337): the noise of a frame is independent of the correction that it sees, so the gain with
    the smallest measured residual is also that with the smallest wavefront error.

    ``density``: spectra ``(n_frequencies, n_modes)`` of the open-loop modes.
    """
    gains = np.geomspace(0.01, largest_gain(delay_frames), _N_GAINS)
    variance = rejection(frequency_hz, rate_hz, gains[:, None], leak, delay_frames) @ density
    return np.asarray(gains[np.argmin(variance, axis=0)])


def pseudo_open_loop(
    residual: NDArray[np.floating], commands: NDArray[np.floating], delay_frames: float
) -> NDArray[np.float32]:
    """Modes of the turbulence ``(n, n_modes)``: residual of a frame minus the command that it sees.

    ``residual``, ``commands``: ``(n, n_modes)`` in one unit, the commands as sent after each frame. A delay
    that is not whole is interpolated; the first frames, whose commands are not known, have the oldest.
    """
    frames = np.arange(len(residual)) - delay_frames
    before = np.floor(frames).astype(int)
    share = (frames - before).astype(np.float32)[:, None]
    first, second = (commands[np.maximum(k, 0)] for k in (before, before + 1))
    return np.asarray(residual - (1 - share) * first - share * second, np.float32)


@dataclass(frozen=True, slots=True)
class SuspiciousElement:
    """An actuator or a sub-aperture whose telemetry differs from that of the others.

    ``kind`` is ``actuator`` or ``sub-aperture``, ``number`` counts from 0 as in slopes or commands.
    """

    kind: str
    number: int
    reason: str
    #: How far it is beyond the threshold, for the order of a list; 1: at the threshold.
    severity: float


def suspicious_actuators(commands: NDArray[np.floating], max_stroke: float = 1.0) -> list[SuspiciousElement]:
    """Actuators that do not move, are at their limit, or move more than the others.

    ``commands``: ``(n, n_act)``, fraction of full stroke; ``max_stroke``: limit of the guard.
    """
    rms = commands.std(axis=0)
    found = _still_or_wild("actuator", rms, "does not move", "moves {:.1f} times as much as the median")
    share = (np.abs(commands) >= _AT_LIMIT * max_stroke).mean(axis=0)
    found += [
        SuspiciousElement("actuator", int(k), f"at its limit in {share[k]:.0%} of the frames",
                          float(share[k] / _LIMIT_SHARE))
        for k in np.flatnonzero(share > _LIMIT_SHARE)
    ]  # fmt: skip
    return sorted(found, key=lambda one: -one.severity)


def suspicious_subapertures(slopes: NDArray[np.floating]) -> list[SuspiciousElement]:
    """Sub-apertures whose slopes do not move, move more than the others, or have another mean.

    ``slopes``: ``(n, n_slopes)``, all x, then all y.
    """
    axes = np.asarray(slopes, float).reshape(len(slopes), 2, -1)
    rms = np.sqrt(axes.var(axis=0).sum(axis=0))
    found = _still_or_wild(
        "sub-aperture", rms, "its slopes do not move", "moves {:.1f} times as much as the median"
    )
    mean = axes.mean(axis=0)
    offset = np.hypot(*(mean - np.median(mean, axis=1, keepdims=True)))
    limit = max(_OUTLIER_SIGMA * NORMAL_RATIO * float(np.median(offset)), float(np.median(rms)))
    found += [
        SuspiciousElement("sub-aperture", int(k), f"mean slope off by {offset[k]:.2g}",
                          float(offset[k] / limit))
        for k in np.flatnonzero(offset > limit) if limit > 0
    ]  # fmt: skip
    return sorted(found, key=lambda one: -one.severity)


def _still_or_wild(kind: str, rms: NDArray[np.floating], still: str, wild: str) -> list[SuspiciousElement]:
    """Elements with an rms near zero, or far above the median of all."""
    median = float(np.median(rms))
    if not median > 0:
        return []
    ratio = rms / median
    logs = np.log(np.maximum(ratio, 1e-9))
    scatter = max(NORMAL_RATIO * float(np.median(np.abs(logs))), _MIN_SCATTER)
    limit = float(np.exp(_OUTLIER_SIGMA * scatter))
    found = [SuspiciousElement(kind, int(k), still, 1e3) for k in np.flatnonzero(ratio < _STILL)]
    return found + [
        SuspiciousElement(kind, int(k), wild.format(ratio[k]), float(ratio[k] / limit))
        for k in np.flatnonzero(ratio > limit)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class LoopFacts:
    """What an analysis needs to know about the loop of a recording.

    Parameters
    ----------
    rate_hz
        Frames per second.
    gain, leak, delay_frames
        Parameters of the integrator, and frames from a command to the slopes that show it.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``; ``None`` if unknown: no pseudo-open-loop modes then.
    nm_per_unit
        Wavefront of a mode at unit amplitude, nm rms.
    max_stroke
        Limit of a command, fraction of full stroke.
    """

    rate_hz: float
    gain: float
    leak: float
    delay_frames: float = 2.0
    m2c: NDArray[np.float64] | None = None
    nm_per_unit: float = 1.0
    max_stroke: float = 1.0
    __repr__ = short_repr


@dataclass(frozen=True, slots=True, eq=False)
class LoopTelemetryArrays:
    """Telemetry of consecutive frames.

    Parameters
    ----------
    index
        Frame numbers ``(n,)``, rising.
    slopes
        ``(n, n_slopes)``, in the sensor's unit.
    commands
        Commands sent after each frame ``(n, n_act)``, fraction of full stroke.
    residual_nm
        Reconstructed residual ``(n, n_modes)``, nm rms wavefront; ``n_modes`` is 0 in open loop.
    """

    index: NDArray[np.int64]
    slopes: NDArray[np.float32]
    commands: NDArray[np.float32]
    residual_nm: NDArray[np.float32]
    __repr__ = short_repr


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryAnalysis:
    """Result of :func:`analyse`; arrays of modes are empty in open loop.

    Parameters
    ----------
    n_frames, n_lost
        Frames of the analysis, and lost ones that were interpolated.
    frequency_hz
        ``(n_frequencies,)``.
    slope_psd
        Mean spectrum of the slopes ``(n_frequencies,)``, slope unit squared per hertz.
    mode_psd, open_loop_psd
        Spectra of the residual and of the pseudo-open-loop modes ``(n_frequencies, n_modes)``, nm^2 / Hz.
    rejection
        Squared rejection of the integrator ``(n_frequencies,)``.
    residual_rms_nm, open_loop_rms_nm, optimal_gain
        By mode ``(n_modes,)``.
    suspicious
        Suspicious actuators and sub-apertures.
    """

    facts: LoopFacts
    n_frames: int
    n_lost: int
    frequency_hz: NDArray[np.float64]
    slope_psd: NDArray[np.float64]
    mode_psd: NDArray[np.float64]
    open_loop_psd: NDArray[np.float64]
    rejection: NDArray[np.float64]
    residual_rms_nm: NDArray[np.float64]
    open_loop_rms_nm: NDArray[np.float64]
    optimal_gain: NDArray[np.float64]
    suspicious: tuple[SuspiciousElement, ...]
    __repr__ = short_repr

    @property
    def largest_gain(self) -> float:
        """Upper limit of :attr:`optimal_gain`."""
        return largest_gain(self.facts.delay_frames)

    @property
    def seconds(self) -> float:
        """Duration of the analysed frames."""
        return self.n_frames / self.facts.rate_hz


def analyse(data: LoopTelemetryArrays, facts: LoopFacts) -> TelemetryAnalysis:
    """Analyse telemetry of consecutive frames.

    Raises
    ------
    ValueError
        Too few frames, or too many lost ones.
    """
    slopes, n_lost = fill_lost_frames(data.index, data.slopes)
    frequency, slope_psd = power_spectra(slopes, facts.rate_hz)
    modes, open_loop = np.zeros((2, len(slopes), 0), np.float32)
    if data.residual_nm.shape[1]:
        modes = fill_lost_frames(data.index, data.residual_nm)[0]
        if facts.m2c is not None and facts.m2c.shape == (data.commands.shape[1], modes.shape[1]):
            commands = fill_lost_frames(data.index, data.commands)[0]
            to_nm = (facts.nm_per_unit * np.linalg.pinv(facts.m2c)).astype(np.float32)
            open_loop = pseudo_open_loop(modes, commands @ to_nm.T, facts.delay_frames)
    empty = np.zeros((frequency.size, 0))
    mode_psd = power_spectra(modes, facts.rate_hz)[1] if modes.size else empty
    open_psd = power_spectra(open_loop, facts.rate_hz)[1] if open_loop.size else empty
    suspicious = suspicious_subapertures(slopes)
    if modes.size:
        suspicious += suspicious_actuators(data.commands, facts.max_stroke)
    return TelemetryAnalysis(
        facts, len(slopes), n_lost, frequency, slope_psd.mean(axis=1), mode_psd, open_psd,
        rejection(frequency, facts.rate_hz, facts.gain, facts.leak, facts.delay_frames),
        np.sqrt(np.mean(np.square(modes, dtype=float), axis=0)), open_loop.std(axis=0, dtype=float),
        optimal_gains(frequency, open_psd, facts.rate_hz, facts.leak, facts.delay_frames)
        if open_loop.size else np.zeros(0),
        tuple(suspicious),
    )  # fmt: skip
