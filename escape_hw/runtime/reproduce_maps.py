"""The paper's matrix of the telescope beside its simulation, and what the paper left for later."""

from __future__ import annotations

from escape_hw.api.procedure import Procedure
from escape_hw.bench import Bench
from escape_hw.errors import Aborted
from escape_hw.runtime.procedures import calibrate_by, model_psf
from escape_hw.runtime.reproduce import Comparison, close_at_best, measured_part

#: Two minutes at 500 Hz: "a few minutes of sky-time" in the paper.
FRAMES = 60_000


def reproduce_maps(bench: Bench, *, frames: int = FRAMES, loop_frames: int = 5000) -> Procedure[Comparison]:
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
    from escape_hw.calibration.docrime import require_frames
    from escape_hw.calibration.pseudo_synthetic import simulated

    require_frames(bench.config.calibration, frames, bench.config.basis.n_modes)
    result = Comparison()
    try:
        found = yield from calibrate_by(bench, "escape", frames=frames)
        result.partial = found.partial
        measured = found if found.partial else measured_part(found)
        if measured is not None:
            result.calibrations["DO-CRIME"] = measured
        if found.partial:
            return result
        result.calibrations["ESCAPE"] = found
        model = yield from model_psf(bench)
        for label in tuple(result.calibrations):
            yield from close_at_best(bench, label, result.calibrations[label], loop_frames, model, result)
            if result.partial:
                return result
        result.calibrations["simulation"] = simulated(bench, found.grid, found.matrix.m2c)
    except Aborted:
        result.partial = True
    return result
