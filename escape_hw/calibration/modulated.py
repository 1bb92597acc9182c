"""Modulation and demodulation: several modes at once, each on a frequency of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import snr_of
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import measured_matrix, next_frame, some_frames
from escape_hw.calibration.checkpoint import Checkpoint
from escape_hw.calibration.demodulation import Lines, find_delay, find_lines, line_frequencies, matrix_from
from escape_hw.calibration.preview import Preview
from escape_hw.calibration.sensor_setup import extractor, modal_basis, poke_amplitudes, ready_sensor
from escape_hw.calibration.stepwise import ROUNDS, StepwiseRun
from escape_hw.calibration.stopping import Target, no_accuracy
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.io.state_file import RunState

#: Band of the lines in cycles per frame: above most of the turbulence and of the bench's vibrations,
#: below where the response of two frames' delay and a frame's hold has faded.
BAND = (0.1, 0.4)
#: Frames at the start of a batch that still hold the mirror's way into the motion.
_RUN_IN = 10
#: Mean squared ratio of elements to their standard errors; noise alone makes it 1.
_LEAST_POWER = 2.0


def modulated(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    until: Target | None = None,
    keep: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Drive batches of modes as sinusoids and detect them in step (Esposito et al. 2006; Pinna et al. 2012).

    Works on a source and under turbulence alike.

    Parameters
    ----------
    bench
        An open bench, loop open.
    frames
        Frames per batch; as configured by default (``calibration.modulated_frames``).
    poke
        Amplitude of each mode, rms surface as fraction of full stroke; as configured by default.
    grid
        The sensor's geometry; found first when not given.
    until
        Drive each batch again until all its modes have this signal-to-noise ratio, up to
        :data:`~escape_hw.calibration.stepwise.ROUNDS` times.
    keep
        Where the state is kept meanwhile, and what to go on with.

    Returns
    -------
    CalibrationResult
        With the delay, found from the phases of all lines. Stopped early, ``partial`` is true and the
        modes of later batches are left out.

    Raises
    ------
    ConfigError
        A number of frames, a poke or a target that means nothing; nothing moved.
    ProductError
        The state to go on with is damaged or of another run; nothing moved.
    TooFewFrames
        Too few frames for a single line.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Stopped before the first batch was done.
    """
    c = bench.config.calibration
    n_frames = c.modulated_frames if frames is None else some_frames(frames)
    m2c = modal_basis(bench)
    amplitude = poke_amplitudes(bench, m2c, c.poke if poke is None else poke)
    n_modes = m2c.shape[1]
    at_once = line_frequencies(n_modes, n_frames, BAND).size
    batches = np.array_split(np.arange(n_modes), -(-n_modes // at_once))
    no_accuracy(until)
    settings = {"poke": float(amplitude.max()), "frames": n_frames}
    state = None if keep is None else keep.begin(bench, "modulated", m2c, settings)
    try:
        grid, mean_frame = yield from ready_sensor(bench, grid if state is None else state.grid)
        report = Reporter("modulation", len(batches) * (n_frames + _RUN_IN))
        run = _Run(bench, extractor(bench, grid), report, mean_frame, keep, frames=n_frames)
        if state is not None:
            run.restore(state)
        partial, preview = False, Preview(n_modes, lambda: grid)
        try:
            for modes in batches[len(run.found) :]:
                yield from run.measure(m2c[:, modes], amplitude[modes], until)
                if preview.due():
                    yield report.now(preview(lambda: run.so_far(c.lags)))
        except Aborted:
            run.kept(always=True)
            if not run.found:
                raise
            partial = True
    finally:
        bench.dm.flatten()
    lines = _joined(run.found)
    delay, error = find_delay(lines, c.lags - 1)
    data, sigma = matrix_from(lines, delay)
    if np.mean(np.square(data / np.maximum(sigma, 1e-300))) < _LEAST_POWER:
        raise CalibrationError("the sensor does not respond to the mirror; is the light on, does it move?")
    delivered, lost = run.counts()
    matrix = measured_matrix(
        bench, grid, m2c[:, : data.shape[1]], data, sigma, "modulated",
        frames=delivered, lost_frames=lost, poke=float(amplitude.max()), batches=len(run.found),
        delay_frames=delay, delay_sigma=error,
    )  # fmt: skip
    return CalibrationResult(
        matrix, run.motion.of(grid), delivered, lost,
        (delivered + lost) / bench.wfs.settings.frame_rate_hz, _response(delay, error, c.lags),
        partial=partial, mean_frame=run.mean_frame,
    )  # fmt: skip


class _Run(StepwiseRun):
    """The batches measured so far, of ``frames`` frames each."""

    def __init__(self, *args: Any, frames: int) -> None:
        super().__init__(*args)
        self.frames = frames
        self.found: list[Lines] = []

    def restore(self, state: RunState) -> None:
        """Go on from a kept state."""
        super().restore(state)
        parts = state.arrays
        self.found = [
            Lines(parts[f"real{k}"] + 1j * parts[f"imaginary{k}"], parts[f"sigma{k}"], parts[f"frequency{k}"])
            for k in range(int(state.values["batches"]))
        ]

    def measure(
        self, m2c: NDArray[np.float64], amplitude: NDArray[np.float64], until: Target | None
    ) -> Procedure[None]:
        """Drive one batch, again until its modes are known as well as asked."""
        rounds: list[Lines] = []
        for _ in range(ROUNDS if until is not None else 1):
            rounds.append((yield from _batch(self, m2c, amplitude)))
            lines = _mean(rounds)
            # Of real and imaginary part alike: the response turns one into the other.
            size = np.sqrt(np.maximum(np.square(np.abs(lines.amplitude)) - np.square(lines.sigma), 0.0))
            if until is None or until.snr is None or snr_of(size, lines.sigma).min() >= until.snr:
                break
        self.found.append(lines)
        self.kept()

    def so_far(self, lags: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix and standard errors of the batches driven ``(n_slopes, n)``."""
        lines = _joined(self.found)
        return matrix_from(lines, find_delay(lines, lags - 1)[0])

    def kept(self, *, always: bool = False) -> None:
        """Keep the state if it is time."""
        arrays: dict[str, NDArray[Any]] = {}
        for k, lines in enumerate(self.found):
            arrays[f"real{k}"], arrays[f"imaginary{k}"] = lines.amplitude.real, lines.amplitude.imag
            arrays[f"sigma{k}"], arrays[f"frequency{k}"] = lines.sigma, lines.frequency
        if self.found:
            self.keep({"batches": len(self.found)}, arrays, always)


def _mean(rounds: list[Lines]) -> Lines:
    """The same lines from several rounds."""
    variance = np.sum([np.square(lines.sigma) for lines in rounds], axis=0)
    amplitude = np.mean([lines.amplitude for lines in rounds], axis=0)
    return Lines(amplitude, np.sqrt(variance) / len(rounds), rounds[0].frequency)


def _batch(run: _Run, m2c: NDArray[np.float64], amplitude: NDArray[np.float64]) -> Procedure[Lines]:
    """Drive some modes for a while and find their lines."""
    bench, frames = run.bench, run.frames
    frequency = line_frequencies(amplitude.size, frames, BAND)
    # Phases that grow with the square of the number keep the sum of many sinusoids low (Schroeder 1970).
    phase = np.pi * np.arange(amplitude.size) ** 2 / amplitude.size
    waves = amplitude * np.sin(np.outer(np.arange(frames + _RUN_IN), frequency) + phase)
    shapes = waves @ m2c.T
    share = _share(bench, shapes)
    times: list[int] = []
    kept: list[NDArray[np.float32]] = []
    first = None
    while not times or times[-1] + 1 < len(shapes):
        frame = next_frame(bench)
        first = frame.index if first is None else first
        # Steps go by the camera's count: a lost frame delays one shape and puts none out of step.
        step = frame.index - first
        slopes = run.slopes_of(frame.data)
        run.light(run.slopes_of.flux)
        run.motion.add(slopes)
        times.append(step)
        kept.append(slopes)
        bench.dm.send(shapes[min(step, len(shapes) - 1)] * share)
        if progress := run.report.step():
            yield progress
    bench.dm.flatten()
    time = np.array(times, np.int64)
    settled = time >= _RUN_IN
    lines = find_lines(time[settled], np.stack(kept)[settled], frequency, amplitude * share, frames)
    turn = np.exp(-1j * phase)
    return Lines(lines.amplitude * turn, lines.sigma, frequency)


def _share(bench: Bench, shapes: NDArray[np.float64]) -> float:
    """Share of a sequence of shapes that the mirror can take without a limit touching any of them."""
    dm = bench.dm
    share = min(1.0, *(float(dm.allowed_share(shape)) for shape in shapes))
    if dm.limits.max_slew is not None:
        fastest = np.abs(np.diff(shapes, axis=0, prepend=0.0)).max()
        share = min(share, dm.limits.max_slew / max(float(fastest), 1e-300))
    return share


def _joined(found: list[Lines]) -> Lines:
    return Lines(
        np.concatenate([lines.amplitude for lines in found], axis=1),
        np.concatenate([lines.sigma for lines in found], axis=1),
        np.concatenate([lines.frequency for lines in found]),
    )


def _response(delay: float, error: float, lags: int) -> TemporalResponse:
    """The delay as the temporal response of the other methods: weights of whole frames."""
    whole = min(int(delay), lags - 2)
    weights, sigma = np.zeros(lags), np.zeros(lags)
    weights[whole : whole + 2] = 1 - (delay - whole), delay - whole
    sigma[whole : whole + 2] = error
    return TemporalResponse(weights, sigma)
