"""The paper's Shack-Hartmann results on one bench: procedures that scripts can use as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief
from escape_hw.api.gains import GainsResult
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult, LoopResult
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.procedures import calibrate_by, model_psf

#: The paper's two runs: 20 seconds and 3 minutes at 500 Hz.
SHORT_FRAMES, LONG_FRAMES = 10_000, 100_000
#: The paper's case, as overrides of a configuration; user overrides go after them.
PAPER_CASE = (
    "twin.registration.shift_x=-16.0",
    "twin.registration.shift_y=-71.0",
    "twin.registration.rotation=-0.77",
    "twin.registration.radial_scaling=2.9",
    "twin.registration.tangential_scaling=0.0",
)


@dataclass(slots=True)
class Comparison:
    """Several calibrations of one system, each with its loop.

    ``loops`` are the runs at each matrix's own best gain, ``scans`` the runs that found it, both by
    label; ``rescaled`` is ESCAPE's matrix as the bootstrap of the optical gains leaves it; ``sky_time``
    holds error curves over a few random plants; ``notes`` say what went wrong on the way; ``partial`` is
    true when the operator stopped it early.
    """

    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    loops: dict[str, LoopResult] = field(default_factory=dict)
    scans: dict[str, list[LoopResult]] = field(default_factory=dict)
    sky_time: dict[str, Any] | None = None
    gains: GainsResult | None = None
    rescaled: CalibrationResult | None = None
    notes: list[str] = field(default_factory=list)
    partial: bool = False
    __repr__ = brief


@dataclass(slots=True)
class Table1Result:
    """ESCAPE with few and with many frames (paper, Table 1), by the heading of the column."""

    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    partial: bool = False
    __repr__ = brief


def reproduce_shwfs(
    bench: Bench, *, frames: int = SHORT_FRAMES, loop_frames: int = 5000, plants: int = 0
) -> Procedure[Comparison]:
    """Calibrate with and without a source and close the loop with every matrix.

    The push-pull baseline and the model PSF are taken with the phase screen out; the DO-CRIME and
    ESCAPE calibrations and all loops run under turbulence. No step reads the twin's truth.

    Parameters
    ----------
    bench
        An open bench with a science camera.
    frames
        Frames of the DO-CRIME measurement.
    loop_frames
        Frames of each final closed-loop run.
    plants
        Random plants for the curve of error against frames; none by default. They run on twins of
        their own, whatever the bench is.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    """
    # Imported here, as every calibration is where it is used.
    from escape_hw.calibration.docrime import require_frames

    # Now, and not after the baseline was measured.
    require_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = Comparison()
    try:
        yield from three_matrices(bench, frames, result)
        if not result.partial:
            yield from _close_loops(bench, loop_frames, result)
        if plants and not result.partial:
            # Imported here: most runs do without the campaign and its process pool.
            from escape_hw.runtime.sky_time import sky_time

            try:
                result.sky_time = yield from sky_time(bench.config, plants=plants)
            except CalibrationError as error:
                # The rest of the result is whole without it.
                result.notes.append(f"no curve of error against frames: {error}")
    except Aborted:
        result.partial = True
    return result


def three_matrices(bench: Bench, frames: int, result: Comparison) -> Procedure[None]:
    """Add the calibrations "push-pull", "DO-CRIME" and "ESCAPE", the latter two from the same frames.

    Parameters
    ----------
    bench
        An open bench.
    frames
        Frames of the DO-CRIME measurement.
    result
        Takes the calibrations; ``partial`` is set when one of them was stopped.
    """
    baseline = yield from calibrate_by(bench, "push-pull")
    result.calibrations["push-pull"] = baseline
    result.partial = baseline.partial
    if result.partial:
        return
    found = yield from calibrate_by(bench, "escape", frames=frames)
    result.partial = found.partial
    if found.partial:
        # Stopped before SPRINT: what there is is a DO-CRIME matrix.
        result.calibrations["DO-CRIME"] = found
        return
    measured = measured_part(found)
    if measured is not None:
        result.calibrations["DO-CRIME"] = measured
    result.calibrations["ESCAPE"] = found


def _close_loops(bench: Bench, loop_frames: int, result: Comparison) -> Procedure[None]:
    model = yield from model_psf(bench)
    for label, calibration in result.calibrations.items():
        yield from close_at_best(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def close_at_best(
    bench: Bench,
    label: str,
    calibration: CalibrationResult,
    loop_frames: int,
    model: NDArray[np.float32],
    result: Comparison,
) -> Procedure[None]:
    """Find a matrix's own best gain, close the loop with it, and add both to the result.

    Parameters
    ----------
    bench
        An open bench with a science camera.
    label
        What the matrix is called in the result.
    calibration
        The matrix, and the geometry that it belongs to.
    loop_frames
        Frames of the loop at the best gain.
    model
        PSF to measure Strehl ratios against.
    result
        Takes the runs; ``partial`` is set when one of them was stopped.

    Raises
    ------
    CalibrationError
        No gain gives a stable loop.
    """
    from escape_hw.calibration.closed_loop import closed_loop
    from escape_hw.calibration.gain_search import best_gain

    matrix, grid = calibration.matrix, calibration.grid
    gain, scan = yield from best_gain(bench, matrix, grid, model_psf=model)
    result.scans[label] = list(scan)
    result.partial = any(run.partial for run in scan)
    if not result.partial:
        loop = yield from closed_loop(bench, matrix, grid, gain=gain, frames=loop_frames, model_psf=model)
        result.loops[label], result.partial = loop, loop.partial


def reproduce_table1(bench: Bench, *, frames: Mapping[str, int] | None = None) -> Procedure[Table1Result]:
    """ESCAPE with each number of frames (paper, Table 1).

    Parameters
    ----------
    frames
        Frames by the heading of the column; SHORT and LONG of the paper by default.
    """
    result = Table1Result()
    try:
        for label, count in (frames or {"SHORT": SHORT_FRAMES, "LONG": LONG_FRAMES}).items():
            found = yield from calibrate_by(bench, "escape", frames=count)
            result.calibrations[label] = found
            if found.partial:
                result.partial = True
                break
    except Aborted:
        result.partial = True
    return result


def measured_part(result: CalibrationResult) -> CalibrationResult | None:
    """The DO-CRIME matrix behind an ESCAPE matrix as a calibration of its own."""
    if result.measured is None:
        return None
    return replace(result, matrix=result.measured, measured=None, registration=None, notes=())
