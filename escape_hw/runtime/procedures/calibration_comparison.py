"""Measure several interaction matrices of one system, their optical gains, and the closed loop with each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import GainsResult, OpticalGains
from escape_hw.api.procedure import Procedure
from escape_hw.api.representation import short_repr
from escape_hw.api.results import CalibrationResult, LoopResult
from escape_hw.bench import Bench
from escape_hw.runtime.procedures.calibration import calibrate_with_method, measured_calibration
from escape_hw.runtime.procedures.model_psf import model_psf

#: Suffix of a matrix's label when the matrix is scaled by its optical gains.
WITH_GAINS = " + OG"
#: Relative standard error of the gains that a round of the paper's 20,000 frames reaches with pokes that
#: cost one percent of the Strehl ratio.
GAIN_ACCURACY = 0.015


@dataclass(slots=True)
class CalibrationComparison:
    """Several calibrations of one system, each with its loop.

    ``loops`` are the runs at each matrix's own best gain, ``scans`` the runs that found it, both by
    label; ``rescaled_calibration`` is ESCAPE's matrix scaled by the bootstrap of the optical gains;
    ``sky_time`` holds error curves over random registrations; ``notes`` report problems; ``partial`` is
    true when the operator stopped the run early.
    """

    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    loops: dict[str, LoopResult] = field(default_factory=dict)
    scans: dict[str, list[LoopResult]] = field(default_factory=dict)
    sky_time: dict[str, Any] | None = None
    gains: GainsResult | None = None
    rescaled_calibration: CalibrationResult | None = None
    notes: list[str] = field(default_factory=list)
    partial: bool = False
    __repr__ = short_repr


def measure_matrices(bench: Bench, frames: int, result: CalibrationComparison) -> Procedure[None]:
    """Add the calibrations "push-pull", "DO-CRIME" and "ESCAPE", the latter two from the same ``frames``.

    Push-pull is measured last, with the sensor geometry and slope references of ESCAPE, so that the matrices
    differ in nothing else. ``result.partial`` is set when one of them was stopped.
    """
    found = yield from calibrate_with_method(bench, "escape", frames=frames)
    result.partial = found.partial
    if found.partial:
        # Stopped before SPRINT: only the DO-CRIME matrix exists.
        result.calibrations["DO-CRIME"] = found
        return
    measured = measured_calibration(found)
    if measured is not None:
        result.calibrations["DO-CRIME"] = measured
    result.calibrations["ESCAPE"] = found
    baseline = yield from calibrate_with_method(bench, "push-pull", grid=found.grid)
    # Tables begin with the baseline.
    result.calibrations, result.partial = {"push-pull": baseline, **result.calibrations}, baseline.partial


def measure_optical_gains(
    bench: Bench, frames: int, result: CalibrationComparison, *, accuracy: float = GAIN_ACCURACY
) -> Procedure[tuple[CalibrationResult, NDArray[np.float32]]]:
    """Add the optical gains of all matrices, measured in closed loop with ESCAPE's.

    A round takes at most ``frames``; the measurement ends at the relative standard error ``accuracy``.
    ``result.partial`` is set when it was stopped. The bench needs a science camera.

    Returns
    -------
    rescaled : CalibrationResult
        ESCAPE's, scaled.
    model : ndarray of float32, ``(rows, columns)``
        The model PSF.
    """
    from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
    from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix

    model = yield from model_psf(bench)
    found = result.calibrations["ESCAPE"]
    others = {label: one.matrix for label, one in result.calibrations.items() if label != "ESCAPE"}
    run = yield from bootstrap_gains(
        bench, found, comparisons=others, frames=frames, accuracy=accuracy,
        closed_loop_matrix=static_light_matrix(bench, found), model_psf=model,
    )  # fmt: skip
    result.gains, result.partial = run.result, run.result.partial
    result.rescaled_calibration = run.rescaled_calibration
    return run.rescaled_calibration, model


def with_and_without_optical_gains(
    known: Mapping[str, CalibrationResult], result: CalibrationComparison
) -> Iterator[tuple[str, CalibrationResult]]:
    """Each matrix unscaled and scaled by its optical gains, with its label."""
    if result.gains is None or result.gains.gains is None:
        return
    gains_of = {"ESCAPE": result.gains.gains, **result.gains.comparisons}
    for label, one in known.items():
        yield label, one
        if label == "ESCAPE" and result.rescaled_calibration is not None:
            yield label + WITH_GAINS, result.rescaled_calibration
        else:
            yield label + WITH_GAINS, scale_by_gains(one, gains_of[label])


def scale_by_gains(calibration: CalibrationResult, gains: OpticalGains) -> CalibrationResult:
    """A calibration with its matrix scaled by its optical gains."""
    from escape_hw.calibration.optical_gain.matrix_comparison import scale_matrix
    from escape_hw.calibration.optical_gain.smoothing import clip_gains

    scaled = scale_matrix(calibration.matrix, clip_gains(gains), gains.best_sigma)
    return replace(calibration, matrix=scaled, measured=None)


def close_loop_at_best_gain(
    bench: Bench,
    label: str,
    calibration: CalibrationResult,
    loop_frames: int,
    model: NDArray[np.float32],
    result: CalibrationComparison,
) -> Procedure[None]:
    """Search a matrix's own best gain, close the loop with it, and add both runs to the result.

    Strehl ratios are measured against ``model``. ``result.partial`` is set when a run was stopped.

    Raises
    ------
    CalibrationError
        No gain gives a stable loop.
    """
    from escape_hw.calibration.loop.gain_search import find_best_gain
    from escape_hw.calibration.loop.performance import close_loop

    matrix, grid = calibration.matrix, calibration.grid
    search = yield from find_best_gain(bench, matrix, grid, model_psf=model)
    result.scans[label] = list(search.runs)
    result.partial = any(run.partial for run in search.runs)
    if not result.partial:
        loop = yield from close_loop(
            bench, matrix, grid, gain=search.gain, frames=loop_frames, model_psf=model
        )
        result.loops[label] = replace(loop, gain_sigma=search.sigma)
        result.partial = loop.partial
