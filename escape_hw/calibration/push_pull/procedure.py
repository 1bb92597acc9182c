"""Push-pull: interaction matrix column by column from positive and negative pokes (paper, Methodology)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import next_frame, ramp_to, validate_frame_count
from escape_hw.calibration.acquisition.sensor_setup import get_sensor_kind
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.push_pull.mode_by_mode import Measurement, ModeByModeRun
from escape_hw.errors import CalibrationError
from escape_hw.io.fits.run_state import RunState

#: Frames after a test step from which the settling time is found.
_STEP_FRAMES = 30
#: Frames of the test step, with those before it.
TEST_STEP_FRAMES = _STEP_FRAMES // 3 + _STEP_FRAMES
#: Relative deviation from the final response below which it has settled.
_SETTLED_FRACTION = 0.02
#: Relative scatter of the final response above which there is none.
_MAX_SCATTER = 0.3


def push_pull(
    bench: Bench,
    *,
    poke: float | None = None,
    frames: int | None = None,
    grid: SensorGeometry | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Push and pull every mode and average the slopes: ``D_i = (s(+a e_i) - s(-a e_i)) / 2 a`` (paper).

    Needs a calibration source; turbulence would dominate the result.

    Parameters
    ----------
    bench
        An open bench without turbulence.
    poke
        Amplitude, rms surface as fraction of full stroke; by default as configured.
    frames
        Frames averaged per push and per pull; by default as configured.
    grid
        Geometry of the sensor; found first if not given.
    until
        Repeat each mode until it has this signal-to-noise ratio, at most
        :data:`~escape_hw.calibration.push_pull.mode_by_mode.MAX_ROUNDS` times.
    checkpoint
        Where the state is saved, and the state to resume from.

    Returns
    -------
    CalibrationResult
        Standard errors are from the scatter of the frames. After an abort ``partial`` is true and the modes
        not measured yet are left out.

    Raises
    ------
    ConfigError
        The number of frames, the poke or the target is out of range; nothing moved.
    ProductError
        The state to resume from is damaged or of another run; nothing moved.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Aborted before the first mode was measured.
    """
    c = bench.config.calibration
    n_frames = c.push_pull_frames if frames is None else validate_frame_count(frames)
    poke = c.push_pull_poke if poke is None else poke
    run = _PushPullRun(bench, poke, n_frames, until, checkpoint)
    partial = yield from run.measure(grid, {"poke": poke, "frames": n_frames})
    return run.build_result(*run.estimate_matrix(), partial, settling_frames=run.settling_frames)


class _PushPullRun(ModeByModeRun):
    """One mode per step; after each poke some frames are skipped and ``frames`` averaged."""

    method = "push-pull"

    @property
    def references(self) -> str:
        return get_sensor_kind(self.bench).source_references

    @property
    def n_steps(self) -> int:
        return int(self.m2c.shape[1])

    def prepare(self) -> Procedure[Reporter]:
        """Find the number of frames to skip after a poke, by a test step of the first mode.

        Raises :class:`CalibrationError` if the sensor does not respond to the mirror.
        """
        report = Reporter("test step", _STEP_FRAMES)
        reference = (yield from self._acquire_slopes(_STEP_FRAMES // 3, report)).mean(axis=0)
        try:
            ramp_to(self.bench.dm, self.m2c[:, 0] * self.amplitude[0] * 3)
            steps = (yield from self._acquire_slopes(_STEP_FRAMES, report)) - reference
        finally:
            self.bench.dm.flatten()
        end = steps[_STEP_FRAMES // 2 :]
        direction = end.mean(axis=0)
        response = steps @ direction / float(direction @ direction)
        scatter = float((end @ direction).std() / (direction @ direction))
        if not scatter < _MAX_SCATTER:
            raise CalibrationError(
                "the wavefront sensor does not respond to a test step of the mirror; "
                "is the light on, and is the turbulence out of the beam?"
            )
        # Noise and vibration may exceed the band later on; only the first half counts.
        off = np.flatnonzero(np.abs(response[: _STEP_FRAMES // 2] - 1) > _SETTLED_FRACTION + 3 * scatter)
        self.settling_frames = int(off[-1]) + 2 if off.size else 1
        return Reporter("push-pull", self.n_steps * 2 * (self.settling_frames + self.frames))

    def measure_step(self, step: int) -> Procedure[Measurement]:
        """Column of one mode and its standard errors, each ``(n_slopes,)``."""
        shape, means, variances, sent = self.m2c[:, step], [], [], []
        for sign in (1.0, -1.0):
            # The amplitude as sent, which the limits may have reduced.
            sent_command = ramp_to(self.bench.dm, sign * self.amplitude[step] * shape).sent
            sent.append(float(sent_command @ shape / (shape @ shape)))
            stack = yield from self._acquire_slopes(
                self.settling_frames + self.frames, self.report, check_flux=True
            )
            stack = stack[self.settling_frames :]
            for slopes in stack:
                self.slope_statistics.add(slopes)
            means.append(stack.mean(axis=0, dtype=np.float64))
            if self.frames > 1:
                variances.append(stack.var(axis=0, ddof=1, dtype=np.float64) / self.frames)
            else:
                variances.append(np.full(stack.shape[1], np.nan))
        amplitude_difference = sent[0] - sent[1]
        if not amplitude_difference > 0:
            raise CalibrationError("the limits left nothing of a poke; lower calibration.push_pull_poke")
        column = (means[0] - means[1]) / amplitude_difference
        return column, np.sqrt(variances[0] + variances[1]) / amplitude_difference

    def _acquire_slopes(
        self, frames: int, report: Reporter, *, check_flux: bool = False
    ) -> Procedure[NDArray[np.float32]]:
        """Slopes of the next frames ``(frames, n_slopes)``."""
        stack = np.empty((frames, self.grid.n_slopes), np.float32)
        for row in stack:
            row[:] = self.slopes_of(next_frame(self.bench).data)
            if check_flux:
                self.flux_monitor(self.slopes_of.flux)
            if progress := report.step():
                yield progress
        return stack

    def estimate_matrix(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        columns, errors = zip(*self.steps, strict=True)
        return np.stack(columns, 1), np.stack(errors, 1)

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        columns, errors = zip(*self.steps, strict=True)
        return {}, {"columns": np.array(columns), "errors": np.array(errors)}

    def restore_steps(self, state: RunState) -> None:
        self.steps = list(zip(state.arrays["columns"], state.arrays["errors"], strict=True))
