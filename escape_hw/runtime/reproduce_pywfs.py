"""The paper's pyramid results on the bench: matrices, optical gains, and loops with and without them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.errors import Aborted
from escape_hw.runtime.procedures import calibrate_by, model_psf
from escape_hw.runtime.reproduce import SHORT_FRAMES, Comparison, close_at_best, measured_part

#: What is added to a matrix's label when it is scaled by its optical gains.
WITH_GAINS = " + OG"
#: Pokes in closed loop (paper: 0.1 to 0.2 % of the stroke).
CLOSED_POKE = 0.002

#: Relative standard error of the gains that a round of the paper's 20,000 frames reaches with pokes that
#: cost one percent of the Strehl ratio.
ACCURACY = 0.015


def reproduce_pywfs(
    bench: Bench, *, frames: int = SHORT_FRAMES, closed_frames: int = 10_000, loop_frames: int = 5000
) -> Procedure[Comparison]:
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
    from escape_hw.calibration.docrime import require_frames

    require_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = Comparison()
    try:
        yield from shared_geometry_matrices(bench, frames, result)
        if not result.partial:
            yield from _gains_and_loops(bench, closed_frames, loop_frames, result)
    except Aborted:
        result.partial = True
    return result


def shared_geometry_matrices(bench: Bench, frames: int, result: Comparison) -> Procedure[None]:
    """Add the calibrations "push-pull", "DO-CRIME" and "ESCAPE" with the geometry of the last for all.

    See :func:`~escape_hw.runtime.reproduce.three_matrices`.
    """
    found = yield from calibrate_by(bench, "escape", frames=frames)
    measured, result.partial = measured_part(found), found.partial
    if found.partial:
        # Stopped before SPRINT: what there is is a DO-CRIME matrix.
        result.calibrations["DO-CRIME"] = found
        return
    baseline = yield from calibrate_by(bench, "push-pull", grid=found.grid)
    result.calibrations["push-pull"], result.partial = baseline, baseline.partial
    if measured is not None:
        result.calibrations["DO-CRIME"] = measured
    result.calibrations["ESCAPE"] = found


def find_gains(
    bench: Bench, frames: int, result: Comparison, *, accuracy: float = ACCURACY
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
    from escape_hw.calibration.gain_bootstrap import bootstrap_gains
    from escape_hw.calibration.pseudo_synthetic import at_rest

    model = yield from model_psf(bench)
    found = result.calibrations["ESCAPE"]
    beside = {label: one.matrix for label, one in result.calibrations.items() if label != "ESCAPE"}
    run = yield from bootstrap_gains(
        bench, found, beside=beside, frames=frames, accuracy=accuracy, shape=at_rest(bench, found),
        model_psf=model,
    )  # fmt: skip
    result.gains, result.rescaled, result.partial = run.result, run.rescaled, run.result.partial
    return run.rescaled, model


def _gains_and_loops(
    bench: Bench, closed_frames: int, loop_frames: int, result: Comparison
) -> Procedure[None]:
    from escape_hw.calibration.docrime_closed import docrime_closed_loop

    known = dict(result.calibrations)
    rescaled, model = yield from find_gains(bench, closed_frames, result)
    if result.partial:
        return
    closed = yield from docrime_closed_loop(bench, rescaled, frames=closed_frames, poke=CLOSED_POKE)
    result.calibrations["DO-CRIME closed"], result.partial = closed, closed.partial
    if closed.partial:
        return
    for label, calibration in with_and_without_gains(known, result):
        yield from close_at_best(bench, label, calibration, loop_frames, model, result)
        if result.partial:
            return


def with_and_without_gains(
    known: dict[str, CalibrationResult], result: Comparison
) -> Iterator[tuple[str, CalibrationResult]]:
    """Each matrix as it is, and scaled by its optical gains."""
    from escape_hw.calibration.gain_smoothing import usable
    from escape_hw.calibration.optical_gain import scaled_matrix

    if result.gains is None or result.gains.gains is None:
        return
    every = {"ESCAPE": result.gains.gains, **result.gains.beside}
    for label, one in known.items():
        yield label, one
        if label == "ESCAPE" and result.rescaled is not None:
            yield label + WITH_GAINS, result.rescaled
            continue
        scaled = scaled_matrix(one.matrix, usable(every[label]), every[label].best_sigma)
        yield label + WITH_GAINS, replace(one, matrix=scaled, measured=None)
