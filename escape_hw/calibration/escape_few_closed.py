"""ESCAPE in a running loop from fewer frames than an interaction matrix takes."""

from __future__ import annotations

from dataclasses import replace

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import Motion, next_frame
from escape_hw.calibration.closed_loop import integrator_for, loop_notes
from escape_hw.calibration.escape_few import few_frames_result, order_for
from escape_hw.calibration.loop_run import CLOSING_S, RunningLoop, require_undiverged
from escape_hw.calibration.loop_tape import LoopTape
from escape_hw.calibration.poke_patterns import random_pattern
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor, random_amplitudes
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.telemetry_sprint import telemetry_sprint
from escape_hw.errors import Aborted


def escape_closed_from_few(
    bench: Bench, closing: CalibrationResult, *, frames: int, poke: float | None = None
) -> Procedure[CalibrationResult]:
    """Registration straight from the telemetry of a few frames of a running loop.

    Parameters
    ----------
    bench
        An open bench.
    closing
        A calibration whose matrix closes the loop.
    frames
        Frames with pokes in them. Those before them, in which the loop closes, are not counted.
    poke
        Pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke.

    Returns
    -------
    CalibrationResult
        On the grid of ``closing``, without a measured matrix, for which there are too few frames.

    Raises
    ------
    TooFewFrames
        Fewer than a noise level can be told from; nothing moved.
    IncompatibleProduct
        The matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop diverged, the sensor went dark, or it does not respond to the pokes.
    Aborted
        Stopped early; frames this few are worth nothing by halves.
    """
    c = bench.config.calibration
    order, poke = order_for(c, frames), c.poke if poke is None else poke
    control = integrator_for(bench, closing.matrix, closing.grid)
    prepare_sensor(bench)
    loop = RunningLoop(bench, closing.matrix.m2c, extractor(bench, closing.grid), control)
    past = 2 * c.whiten_order + c.lags
    tape = LoopTape(closing.grid.n_slopes, closing.matrix.n_modes, past + frames, past)
    motion = Motion(closing.grid.n_slopes)
    yield from _recorded(loop, frames, poke, past, tape, motion)
    found, data = motion.of(closing.grid, closed=True), _whole(tape, c.whiten_order + c.lags)
    registration = closing.registration
    fit = yield from telemetry_sprint(
        data, closing.matrix, bench.model(found), order=order, lags=c.lags, known=closing.response,
        start=None if registration is None else registration.registration,
        learning_rate=c.learning_rate, solver=c.solver, loss=c.loss, also=c.also,
        actuators=c.actuators,
    )  # fmt: skip
    result = few_frames_result(
        bench, fit, found, closing.matrix.m2c, frames=frames, lost=tape.lost, poke=float(poke), order=order,
        shortened=loop.record.shortened,
    )  # fmt: skip
    notes = loop_notes(loop.record, bench.wfs.settings.frame_rate_hz)
    return replace(result, grid=found, notes=(*result.notes, *notes))


def _recorded(
    loop: RunningLoop, frames: int, poke: float, past: int, tape: LoopTape, motion: Motion
) -> Procedure[None]:
    """Close the loop, poke while the tape runs, open it; the mirror ends flat."""
    bench = loop.bench
    amplitude = random_amplitudes(bench, loop.m2c, poke)
    pokes = random_pattern(bench.config.calibration.pokes)(amplitude, bench.rng)
    closing = max(int(CLOSING_S * bench.wfs.settings.frame_rate_hz) - past, 0)
    stage = f"{pokes.title} in closed loop"
    bench.dm.flatten()
    # One frame first: what the camera lost while nobody read it is not a loss of the loop.
    next_frame(bench)
    try:
        yield from loop.run(closing, report=Reporter("closing the loop", closing))
        yield from loop.run(past, observe=(tape,), report=Reporter("closing the loop", past))
        watch = (tape, lambda _index, slopes, _command, _poke: motion.add(slopes))
        yield from loop.run(frames, inject=pokes, observe=watch, report=Reporter(stage, frames))
    except Aborted:
        raise Aborted(
            f"aborted after {loop.record.frames} of {closing + past + frames} frames, too few for a "
            "registration"
        ) from None
    finally:
        bench.dm.flatten()
    require_undiverged(loop.record)


def _whole(tape: LoopTape, unknown: int) -> Telemetry:
    """The tape; slopes whose commands of all lags and filters are not on it count as lost."""
    data, _ = tape.handover()
    data.present[:unknown] = False
    data.slopes[:unknown] = 0
    return data
