"""The gain with which a matrix closes the loop best."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import LoopResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.control.integrator import gain_limit

#: Shares of the stable limit that the search for the best gain tries.
GAIN_FRACTIONS = (0.25, 0.35, 0.45, 0.55, 0.65, 0.75)
#: Gains tried beyond those while the loop gets better and better towards one end, and the factors
#: between them: on the way up small, because the loop's limit is near.
_MAX_EXTRA_GAINS, _STEP_UP, _STEP_DOWN = 4, 1.2, 1 / 1.5
#: Delay assumed for the gain's limit when the matrix does not carry a measured one.
_DEFAULT_DELAY_FRAMES = 2.0


def best_gain(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gains: tuple[float, ...] | None = None,
    frames: int = 1500,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[tuple[float, list[LoopResult]]]:
    """The gain with the least residual (or the highest Strehl ratio, given a model PSF).

    Parameters
    ----------
    bench, matrix, grid
        As for :func:`close_loop`.
    gains
        Gains to try; by default shares of the largest stable one for the delay that was measured
        with the matrix.
    frames
        Frames per gain.
    model_psf
        With it, gains are judged by the Strehl ratio.

    Raises
    ------
    CalibrationError
        No gain gives a stable loop.
    """
    delay = float(matrix.metrics.get("delay_frames", _DEFAULT_DELAY_FRAMES))
    pending = list(gains or (share * gain_limit(delay) for share in GAIN_FRACTIONS))
    extra_gains = 0 if gains else _MAX_EXTRA_GAINS
    runs: list[LoopResult] = []
    while pending:
        gain = pending.pop(0)
        run = yield from close_loop(
            bench,
            matrix,
            grid,
            gain=gain,
            frames=frames,
            model_psf=model_psf,
            stage=f"loop at gain {gain:.2f}",
        )
        runs.append(run)
        if run.partial:
            return gain, runs
        if sum(not r.stable for r in runs) > 1:
            pending = []
        next_gain = _next_gain(runs) if extra_gains and not pending else None
        if next_gain is not None:
            # The top is not passed yet: a best gain at the edge of the scan is none.
            pending, extra_gains = [next_gain], extra_gains - 1
    stable = [run for run in runs if run.stable]
    if not stable:
        raise CalibrationError(
            f"the loop closes at none of the gains {', '.join(f'{r.gain:.2f}' for r in runs)}; "
            "drop more modes or measure the matrix again"
        )
    return _fit_peak(stable), runs


def _next_gain(runs: list[LoopResult]) -> float | None:
    """A gain beyond the end of the scan at which the best loop lies; ``None`` if it lies within."""
    by_gain = sorted(runs, key=lambda run: run.gain)
    stable = [run for run in by_gain if run.stable]
    best = stable[int(np.argmax(_compute_merits(stable)))] if stable else None
    if best is None or best is by_gain[0]:
        return by_gain[0].gain * _STEP_DOWN
    return best.gain * _STEP_UP if best is by_gain[-1] else None


def _fit_peak(runs: list[LoopResult]) -> float:
    """Gain at the top of a parabola through the merits, so that one lucky run does not decide.

    With fewer than four runs, or where the parabola has no top, the best run's gain.
    """
    gains = np.array([run.gain for run in runs])
    merits = _compute_merits(runs)
    best = float(gains[int(np.argmax(merits))])
    if gains.size < 4:
        return best
    curvature, slope, _ = np.polyfit(gains, merits, 2)
    if curvature >= 0:
        return best
    return float(np.clip(-slope / (2 * curvature), gains.min(), gains.max()))


def _compute_merits(runs: list[LoopResult]) -> NDArray[np.float64]:
    """Strehl ratios, or (as soon as one run has none) residuals: never one beside the other."""
    ratios = [run.strehl.peak.value for run in runs if run.strehl is not None]
    return np.array(ratios if len(ratios) == len(runs) else [-run.residual_rms_nm for run in runs])
