"""The paper's experiments as procedures: Table 1, Shack-Hartmann bench, pyramid bench, telescope."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.procedure import Procedure
from escape_hw.api.representation import short_repr
from escape_hw.api.results import CalibrationResult, LoopResult
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.procedures.calibration import (
    calibrate_with_method,
    measured_calibration,
    model_psf,
)

#: The paper's two runs: 20 seconds and 3 minutes at 500 Hz.
SHORT_FRAMES, LONG_FRAMES = 10_000, 100_000
#: The paper's case, as overrides of a configuration; user overrides go after them.
PAPER_REGISTRATION = (
    "twin.registration.shift_x=-16.0",
    "twin.registration.shift_y=-71.0",
    "twin.registration.rotation=-0.77",
    "twin.registration.radial_scaling=2.9",
    "twin.registration.tangential_scaling=0.0",
)


@dataclass(slots=True)
class CalibrationComparison:
    """Several calibrations of one system, each with its loop.

    ``loops`` are the runs at each matrix's own best gain, ``scans`` the runs that found it, both by
    label; ``rescaled_calibration`` is ESCAPE's matrix as the bootstrap of the optical gains leaves it; ``sky_time``
    holds error curves over a few random plants; ``notes`` say what went wrong on the way; ``partial`` is
    true when the operator stopped it early.
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


@dataclass(slots=True)
class Table1Result:
    """ESCAPE with few and with many frames (paper, Table 1), by the heading of the column."""

    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    partial: bool = False
    __repr__ = short_repr


def reproduce_shwfs(
    bench: Bench, *, frames: int = SHORT_FRAMES, loop_frames: int = 5000, plants: int = 0
) -> Procedure[CalibrationComparison]:
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
    from escape_hw.calibration.docrime.open_loop import require_enough_frames

    # Now, and not after the baseline was measured.
    require_enough_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = CalibrationComparison()
    try:
        yield from measure_matrices(bench, frames, result)
        if not result.partial:
            yield from _close_loops(bench, loop_frames, result)
        if plants and not result.partial:
            # Imported here: most runs do without the campaign and its process pool.
            from escape_hw.paper.sky_time import sky_time

            try:
                result.sky_time = yield from sky_time(bench.config, plants=plants)
            except CalibrationError as error:
                # The rest of the result is whole without it.
                result.notes.append(f"no curve of error against frames: {error}")
    except Aborted:
        result.partial = True
    return result


def measure_matrices(bench: Bench, frames: int, result: CalibrationComparison) -> Procedure[None]:
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
    baseline = yield from calibrate_with_method(bench, "push-pull")
    result.calibrations["push-pull"] = baseline
    result.partial = baseline.partial
    if result.partial:
        return
    found = yield from calibrate_with_method(bench, "escape", frames=frames)
    result.partial = found.partial
    if found.partial:
        # Stopped before SPRINT: what there is is a DO-CRIME matrix.
        result.calibrations["DO-CRIME"] = found
        return
    measured = measured_calibration(found)
    if measured is not None:
        result.calibrations["DO-CRIME"] = measured
    result.calibrations["ESCAPE"] = found


def _close_loops(bench: Bench, loop_frames: int, result: CalibrationComparison) -> Procedure[None]:
    model = yield from model_psf(bench)
    for label, calibration in result.calibrations.items():
        yield from close_loop_at_best_gain(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def close_loop_at_best_gain(
    bench: Bench,
    label: str,
    calibration: CalibrationResult,
    loop_frames: int,
    model: NDArray[np.float32],
    result: CalibrationComparison,
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
    from escape_hw.calibration.loop.gain_search import find_best_gain
    from escape_hw.calibration.loop.performance import close_loop

    matrix, grid = calibration.matrix, calibration.grid
    search = yield from find_best_gain(bench, matrix, grid, model_psf=model)
    result.scans[label] = search.runs
    result.partial = any(run.partial for run in search.runs)
    if not result.partial:
        loop = yield from close_loop(
            bench, matrix, grid, gain=search.gain, frames=loop_frames, model_psf=model
        )
        result.loops[label], result.partial = replace(loop, gain_sigma=search.sigma), loop.partial


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
            found = yield from calibrate_with_method(bench, "escape", frames=count)
            result.calibrations[label] = found
            if found.partial:
                result.partial = True
                break
    except Aborted:
        result.partial = True
    return result


#: What is added to a matrix's label when it is scaled by its optical gains.
WITH_GAINS = " + OG"
#: Pokes in closed loop (paper: 0.1 to 0.2 % of the stroke).
CLOSED_POKE = 0.002

#: Relative standard error of the gains that a round of the paper's 20,000 frames reaches with pokes that
#: cost one percent of the Strehl ratio.
GAIN_ACCURACY = 0.015


def reproduce_pywfs(
    bench: Bench, *, frames: int = SHORT_FRAMES, closed_frames: int = 10_000, loop_frames: int = 5000
) -> Procedure[CalibrationComparison]:
    """Four matrices, the optical gains of three, and six loops.

    All share the geometry and the references found under turbulence, so that nothing but the matrix
    differs between the loops. No step reads the twin's truth.

    Parameters
    ----------
    bench
        An open pyramid bench with a science camera.
    frames
        Frames of the DO-CRIME measurement in open loop.
    closed_frames
        Frames of each round of the optical gains at most, and of the DO-CRIME matrix in closed loop.
    loop_frames
        Frames of each closed loop at its best gain.

    Returns
    -------
    Comparison
        Calibrations "push-pull" (source, no turbulence), "DO-CRIME" (open loop), "DO-CRIME closed"
        and "ESCAPE"; ``gains``; loops of three of them with and without optical gains.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    CalibrationError
        A loop closes at no gain.
    """
    from escape_hw.calibration.docrime.open_loop import require_enough_frames

    require_enough_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = CalibrationComparison()
    try:
        yield from measure_matrices_on_one_geometry(bench, frames, result)
        if not result.partial:
            yield from _gains_and_loops(bench, closed_frames, loop_frames, result)
    except Aborted:
        result.partial = True
    return result


def measure_matrices_on_one_geometry(
    bench: Bench, frames: int, result: CalibrationComparison
) -> Procedure[None]:
    """Add the calibrations "push-pull", "DO-CRIME" and "ESCAPE" with the geometry of the last for all.

    See :func:`~escape_hw.paper.experiments.measure_matrices`.
    """
    found = yield from calibrate_with_method(bench, "escape", frames=frames)
    measured, result.partial = measured_calibration(found), found.partial
    if found.partial:
        # Stopped before SPRINT: what there is is a DO-CRIME matrix.
        result.calibrations["DO-CRIME"] = found
        return
    baseline = yield from calibrate_with_method(bench, "push-pull", grid=found.grid)
    result.calibrations["push-pull"], result.partial = baseline, baseline.partial
    if measured is not None:
        result.calibrations["DO-CRIME"] = measured
    result.calibrations["ESCAPE"] = found


def measure_optical_gains(
    bench: Bench, frames: int, result: CalibrationComparison, *, accuracy: float = GAIN_ACCURACY
) -> Procedure[tuple[CalibrationResult, NDArray[np.float32]]]:
    """Add the optical gains of all matrices, found in closed loop on ESCAPE's.

    Parameters
    ----------
    bench
        An open bench with a science camera.
    frames
        Frames per round at most.
    result
        With the matrices; takes the gains, and ``partial`` when they were stopped.
    accuracy
        Relative standard error of the gains to go on for.

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
    beside = {label: one.matrix for label, one in result.calibrations.items() if label != "ESCAPE"}
    run = yield from bootstrap_gains(
        bench, found, comparisons=beside, frames=frames, accuracy=accuracy,
        closed_loop_matrix=static_light_matrix(bench, found),
        model_psf=model,
    )  # fmt: skip
    result.gains, result.rescaled_calibration, result.partial = (
        run.result,
        run.rescaled_calibration,
        run.result.partial,
    )
    return run.rescaled_calibration, model


def _gains_and_loops(
    bench: Bench, closed_frames: int, loop_frames: int, result: CalibrationComparison
) -> Procedure[None]:
    from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop

    known = dict(result.calibrations)
    rescaled_calibration, model = yield from measure_optical_gains(bench, closed_frames, result)
    if result.partial:
        return
    closed = yield from docrime_closed_loop(
        bench, rescaled_calibration, frames=closed_frames, poke=CLOSED_POKE
    )
    result.calibrations["DO-CRIME closed"], result.partial = closed, closed.partial
    if closed.partial:
        return
    for label, calibration in with_and_without_optical_gains(known, result):
        yield from close_loop_at_best_gain(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def with_and_without_optical_gains(
    known: dict[str, CalibrationResult], result: CalibrationComparison
) -> Iterator[tuple[str, CalibrationResult]]:
    """Each matrix as it is, and scaled by its optical gains."""
    from escape_hw.calibration.optical_gain.matrix_comparison import scale_matrix
    from escape_hw.calibration.optical_gain.smoothing import clip_gains

    if result.gains is None or result.gains.gains is None:
        return
    every = {"ESCAPE": result.gains.gains, **result.gains.comparisons}
    for label, one in known.items():
        yield label, one
        if label == "ESCAPE" and result.rescaled_calibration is not None:
            yield label + WITH_GAINS, result.rescaled_calibration
            continue
        scaled = scale_matrix(one.matrix, clip_gains(every[label]), every[label].best_sigma)
        yield label + WITH_GAINS, replace(one, matrix=scaled, measured=None)


#: Two minutes at 500 Hz: "a few minutes of sky-time" in the paper.
MAPS_FRAMES = 60_000


def reproduce_maps(
    bench: Bench, *, frames: int = MAPS_FRAMES, loop_frames: int = 5000
) -> Procedure[CalibrationComparison]:
    """Measure a matrix on the sky, find the registration, and close the loop with either matrix.

    The paper shows a matrix of 100 modes beside a simulated one and gives up on a pseudo-synthetic
    matrix, because part of the mirror is contaminated and part of the pupil badly lit. Here that
    matrix is made, and judged by its loop.

    Parameters
    ----------
    bench
        An open telescope with a science camera.
    frames
        Frames of the DO-CRIME measurement.
    loop_frames
        Frames of each closed loop.

    Returns
    -------
    Comparison
        Calibrations "DO-CRIME", "ESCAPE" and "simulation" (the model with the mirror where the design
        has it); loops of the first two.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    CalibrationError
        A loop closes at no gain.
    """
    from escape_hw.calibration.docrime.open_loop import require_enough_frames
    from escape_hw.calibration.sprint.synthetic_matrix import nominal_calibration

    require_enough_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = CalibrationComparison()
    try:
        found = yield from calibrate_with_method(bench, "escape", frames=frames)
        result.partial = found.partial
        measured = found if found.partial else measured_calibration(found)
        if measured is not None:
            result.calibrations["DO-CRIME"] = measured
        if found.partial:
            return result
        result.calibrations["ESCAPE"] = found
        model = yield from model_psf(bench)
        for label in tuple(result.calibrations):
            yield from close_loop_at_best_gain(
                bench, label, result.calibrations[label], loop_frames, model, result
            )
            if result.partial:
                return result
        result.calibrations["simulation"] = nominal_calibration(bench, found.grid, found.matrix.m2c)
    except Aborted:
        result.partial = True
    return result
