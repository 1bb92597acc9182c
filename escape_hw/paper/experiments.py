"""The paper's experiments as procedures: Table 1, Shack-Hartmann bench, pyramid bench, telescopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from escape_hw.api.procedure import Procedure
from escape_hw.api.representation import short_repr
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.runtime.procedures.calibration import calibrate_with_method, measured_calibration
from escape_hw.runtime.procedures.calibration_comparison import (
    CalibrationComparison,
    close_loop_at_best_gain,
    measure_matrices,
    measure_optical_gains,
    with_and_without_optical_gains,
)
from escape_hw.runtime.procedures.model_psf import model_psf

#: Pokes in closed loop (paper: 0.1 to 0.2 % of the stroke).
CLOSED_POKE = 0.002
#: The paper's registration, as overrides of a configuration; those of the user follow them.
PAPER_REGISTRATION = (
    "twin.registration.shift_x=-16.0",
    "twin.registration.shift_y=-71.0",
    "twin.registration.rotation=-0.77",
    "twin.registration.radial_scaling=2.9",
    "twin.registration.tangential_scaling=0.0",
)


@dataclass(slots=True)
class Table1Result:
    """ESCAPE with few and with many frames (paper, Table 1), by the heading of the column."""

    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    partial: bool = False
    __repr__ = short_repr


def reproduce_table1(bench: Bench, *, frames: Mapping[str, int]) -> Procedure[Table1Result]:
    """ESCAPE with each number of frames (paper, Table 1), by the heading of the column."""
    result = Table1Result()
    try:
        for label, count in frames.items():
            found = yield from calibrate_with_method(bench, "escape", frames=count)
            result.calibrations[label] = found
            if found.partial:
                result.partial = True
                break
    except Aborted:
        result.partial = True
    return result


def reproduce_shwfs(
    bench: Bench, *, frames: int, loop_frames: int, realisations: int = 0
) -> Procedure[CalibrationComparison]:
    """Calibrate a bench with and without a source, and close the loop with every matrix.

    The push-pull baseline and the model PSF are measured without the phase screen; the DO-CRIME and
    ESCAPE calibrations and all loops under turbulence. All share the sensor geometry and the slope references
    measured under turbulence, so that the loops differ in the matrix only. No step reads the true state of a
    simulation.

    Parameters
    ----------
    frames
        Frames of the DO-CRIME measurement.
    loop_frames
        Frames of each final closed loop.
    realisations
        Random registrations for the curve of error against frames; none by default. They are simulated,
        also for a bench with hardware.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    """

    def evaluate(result: CalibrationComparison) -> Procedure[None]:
        yield from _close_loops(bench, loop_frames, result)
        if realisations and not result.partial:
            from escape_hw.paper.sky_time import sky_time

            try:
                result.sky_time = yield from sky_time(bench.config, realisations=realisations)
            except CalibrationError as error:
                # The other results do not depend on it.
                result.notes.append(f"no curve of error against frames: {error}")

    return (yield from _compare(bench, frames, partial(measure_matrices, bench, frames), evaluate))


def _compare(
    bench: Bench,
    frames: int,
    measure: Callable[[CalibrationComparison], Procedure[None]],
    evaluate: Callable[[CalibrationComparison], Procedure[None]],
) -> Procedure[CalibrationComparison]:
    """Check the frames before anything moves, measure matrices, and evaluate them unless that was aborted."""
    from escape_hw.calibration.docrime.open_loop import require_enough_frames

    require_enough_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = CalibrationComparison()
    try:
        yield from measure(result)
        if not result.partial:
            yield from evaluate(result)
    except Aborted:
        result.partial = True
    return result


def _close_loops(bench: Bench, loop_frames: int, result: CalibrationComparison) -> Procedure[None]:
    model = yield from model_psf(bench)
    for label, calibration in tuple(result.calibrations.items()):
        yield from close_loop_at_best_gain(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def reproduce_pywfs(
    bench: Bench, *, frames: int, closed_frames: int, loop_frames: int
) -> Procedure[CalibrationComparison]:
    """Measure four matrices and the optical gains of three on a pyramid bench, and close six loops.

    All share the sensor geometry and the references measured under turbulence, so that the loops differ
    in the matrix only. No step reads the true state of a simulation.

    Parameters
    ----------
    frames
        Frames of the DO-CRIME measurement in open loop.
    closed_frames
        Frames of each round of the optical gains at most, and of the DO-CRIME matrix in closed loop.
    loop_frames
        Frames of each closed loop at its best gain.

    Returns
    -------
    CalibrationComparison
        Calibrations "push-pull" (source, no turbulence), "DO-CRIME" (open loop), "DO-CRIME closed"
        and "ESCAPE"; ``gains``; loops of three of them with and without optical gains.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    CalibrationError
        No gain gives a stable loop.
    """
    measure = partial(measure_matrices, bench, frames)
    evaluate = partial(_gains_and_loops, bench, closed_frames, loop_frames)
    return (yield from _compare(bench, frames, measure, evaluate))


def _gains_and_loops(
    bench: Bench, closed_frames: int, loop_frames: int, result: CalibrationComparison
) -> Procedure[None]:
    from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop

    known = dict(result.calibrations)
    rescaled, model = yield from measure_optical_gains(bench, closed_frames, result)
    if result.partial:
        return
    closed = yield from docrime_closed_loop(bench, rescaled, frames=closed_frames, poke=CLOSED_POKE)
    result.calibrations["DO-CRIME closed"], result.partial = closed, closed.partial
    if closed.partial:
        return
    for label, calibration in with_and_without_optical_gains(known, result):
        yield from close_loop_at_best_gain(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def reproduce_maps(bench: Bench, *, frames: int, loop_frames: int) -> Procedure[CalibrationComparison]:
    """Measure a matrix on the sky, fit the registration, and close the loop with either matrix.

    The paper shows a matrix of 100 modes beside a simulated one and does not attempt a pseudo-synthetic
    matrix, because part of the mirror is contaminated and part of the pupil poorly illuminated. Here that
    matrix is computed and evaluated by its loop.

    Parameters
    ----------
    frames
        Frames of the DO-CRIME measurement.
    loop_frames
        Frames of each closed loop.

    Returns
    -------
    CalibrationComparison
        Calibrations "DO-CRIME", "ESCAPE" and "simulation" (the model with the nominal registration);
        loops of the first two.

    Raises
    ------
    TooFewFrames
        For the number of modes; nothing moved.
    CalibrationError
        No gain gives a stable loop.
    """
    from escape_hw.calibration.sprint.synthetic_matrix import nominal_calibration

    def measure(result: CalibrationComparison) -> Procedure[None]:
        found = yield from calibrate_with_method(bench, "escape", frames=frames)
        result.partial = found.partial
        measured = found if found.partial else measured_calibration(found)
        if measured is not None:
            result.calibrations["DO-CRIME"] = measured
        if not found.partial:
            result.calibrations["ESCAPE"] = found

    def evaluate(result: CalibrationComparison) -> Procedure[None]:
        yield from _close_loops(bench, loop_frames, result)
        if not result.partial:
            found = result.calibrations["ESCAPE"]
            result.calibrations["simulation"] = nominal_calibration(bench, found.grid, found.matrix.m2c)

    return (yield from _compare(bench, frames, measure, evaluate))
