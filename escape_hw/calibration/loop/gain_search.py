"""Search for the loop gain with the highest Strehl ratio or the lowest residual."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import LoopResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.control.integrator import gain_limit

#: Gains of the scan as fractions of the largest stable gain.
GAIN_FRACTIONS = (0.25, 0.35, 0.45, 0.55, 0.65, 0.75)
#: Further gains tried while the best one lies at an end of the scan, and the ratios between them: small
#: upwards, where the limit of stability is near.
_MAX_EXTRA_GAINS, _STEP_UP, _STEP_DOWN = 4, 1.2, 1 / 1.5
#: Fewest runs through which a parabola is fitted.
_MIN_PARABOLA_RUNS = 4
#: Delay assumed for the largest stable gain when the matrix has no measured one.
_DEFAULT_DELAY_FRAMES = 2.0
#: A run that is worse than the best by d deviates from a parabola about the top by this times d.
_PARABOLA_MISFIT = 0.5
#: Relative error assumed for all runs, as a fraction of their range, when their own errors are unknown; only
#: the weights depend on it.
_NOMINAL_ERROR = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class GainSearch:
    """Result of a search for the best gain; unpacks as ``gain, runs``.

    ``gain``, ``sigma``: the best gain and its standard error, NaN if the search was stopped; ``runs``: one
    run per gain tried.
    """

    gain: float
    sigma: float
    runs: list[LoopResult]

    def __iter__(self) -> Iterator[Any]:
        return iter((self.gain, self.runs))


def find_best_gain(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gains: tuple[float, ...] | None = None,
    frames: int = 1500,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[GainSearch]:
    """Close the loop at several gains and find the best one.

    Parameters
    ----------
    matrix, grid
        Interaction matrix, and the sensor geometry that it was measured on.
    gains
        Gains to try; by default fractions of the largest stable gain for the delay that was measured with
        the matrix, continued beyond either end while the best gain lies there.
    frames
        Frames per gain.
    model_psf
        PSF without turbulence ``(rows, columns)``. With it gains are compared by the Strehl ratio of the
        peak, else by the residual.

    Returns
    -------
    GainSearch
        The top of a parabola through the gains near the best one, with its standard error.

    Raises
    ------
    CalibrationError
        No gain gives a stable loop.
    """
    delay = float(matrix.metrics.get("delay_frames", _DEFAULT_DELAY_FRAMES))
    pending = list(gains or (fraction * gain_limit(delay) for fraction in GAIN_FRACTIONS))
    extra_gains = 0 if gains else _MAX_EXTRA_GAINS
    runs: list[LoopResult] = []
    while pending:
        gain = pending.pop(0)
        run = yield from close_loop(
            bench, matrix, grid,
            gain=gain, frames=frames, model_psf=model_psf, stage=f"loop at gain {gain:.2f}",
        )  # fmt: skip
        runs.append(run)
        if run.partial:
            return GainSearch(gain, math.nan, runs)
        if sum(not r.stable for r in runs) > 1:
            pending = []
        next_gain = _next_gain(runs) if extra_gains and not pending else None
        if next_gain is not None:
            pending, extra_gains = [next_gain], extra_gains - 1
    stable = [run for run in runs if run.stable]
    if not stable:
        raise CalibrationError(
            f"the loop closes at none of the gains {', '.join(f'{r.gain:.2f}' for r in runs)}; "
            "drop more modes or measure the matrix again"
        )
    return GainSearch(*_fit_peak(stable), runs)


def _next_gain(runs: list[LoopResult]) -> float | None:
    """A gain beyond the end of the scan where the best one seems to lie; ``None`` if it lies within the scan.

    It lies where the best run is, or the top of the parabola: the Strehl ratios of short runs scatter by more
    than those of neighbouring gains differ.
    """
    by_gain = sorted(runs, key=lambda run: run.gain)
    stable = [run for run in by_gain if run.stable]
    if not stable:
        return by_gain[0].gain * _STEP_DOWN
    merits = _compute_merits(stable)[0]
    best = stable[int(np.argmax(merits))]
    top = _fit_parabola(stable)[0] if _allows_parabola(merits) else best.gain
    if best is by_gain[0] or top < by_gain[0].gain:
        return by_gain[0].gain * _STEP_DOWN
    last, above = by_gain[-1], by_gain[-1].gain * _STEP_UP
    return above if last.stable and (best is last or top > last.gain) and above <= MAX_GAIN else None


def _fit_peak(runs: list[LoopResult]) -> tuple[float, float]:
    """Gain of the highest merit and its standard error: the top of a parabola.

    If the top lies beyond the gains, the result is the gain at that end; with few runs, or equal ones, that
    of the best run. The error then is that of a uniform distribution between the neighbours.
    """
    runs = sorted(runs, key=lambda run: run.gain)
    gains = np.array([run.gain for run in runs])
    merits, _ = _compute_merits(runs)
    nearest = int(np.argmax(merits))
    if _allows_parabola(merits):
        top, sigma = _fit_parabola(runs)
        if gains[0] <= top <= gains[-1]:
            return top, sigma
        nearest = 0 if top < gains[0] else gains.size - 1
    below, above = max(nearest - 1, 0), min(nearest + 1, gains.size - 1)
    return float(gains[nearest]), float(gains[above] - gains[below]) / math.sqrt(12) or math.nan


def _allows_parabola(merits: NDArray[np.float64]) -> bool:
    return merits.size >= _MIN_PARABOLA_RUNS and bool(np.ptp(merits) > 0)


def _fit_parabola(runs: list[LoopResult]) -> tuple[float, float]:
    """Top of a parabola through the merits, and its standard error; infinite if it has no top.

    Each run is weighted by its standard error and by the deviation of the curve from a parabola, which grows
    with the distance from the top, so that runs far below the top do not displace it.
    """
    gains = np.array([run.gain for run in runs])
    merits, errors = _compute_merits(runs)
    best, spread = int(np.argmax(merits)), float(np.ptp(merits))
    known = bool(np.isfinite(errors).all())
    statistical = np.maximum(errors, 1e-3 * spread) if known else np.full(gains.size, _NOMINAL_ERROR * spread)
    weight = 1 / np.hypot(statistical, _PARABOLA_MISFIT * (merits[best] - merits))
    scale = float(np.ptp(gains))
    position = (gains - gains[best]) / scale
    design = np.stack([np.ones_like(position), position, np.square(position)], axis=1) * weight[:, None]
    covariance = np.linalg.inv(design.T @ design)
    coefficients = covariance @ (design.T @ (merits * weight))
    _, slope, curvature = coefficients
    if not curvature < 0:
        return math.copysign(math.inf, slope), math.nan
    top = -slope / (2 * curvature)
    chi_squared = float(np.square(merits * weight - design @ coefficients).sum()) / (gains.size - 3)
    covariance *= max(chi_squared, 1.0) if known else chi_squared
    derivative = np.array([0.0, -1.0, -2 * top]) / (2 * curvature)
    sigma = scale * math.sqrt(float(derivative @ covariance @ derivative))
    return float(gains[best] + scale * top), sigma


def _compute_merits(runs: list[LoopResult]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Strehl ratios and their errors or, if a run has none, negative residuals and NaN."""
    ratios = [run.strehl.peak for run in runs if run.strehl is not None]
    if len(ratios) == len(runs):
        return np.array([one.value for one in ratios]), np.array([one.sigma for one in ratios])
    return np.array([-run.residual_rms_nm for run in runs]), np.full(len(runs), math.nan)
