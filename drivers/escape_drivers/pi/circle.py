"""Circular motion of a PI stage: wave tables, measurement of the circle, correction."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_drivers.pi.controller import E727
from escape_drivers.pi.travel import AxisTravel
from escape_drivers.pi.wave_table import (
    MAX_POINTWISE,
    CycleTiming,
    circle_targets,
    evaluate_sine_table,
    fit_phasors,
    fit_sine_table,
    nearest_timing,
    response_from_row,
    response_to_row,
)
from escape_hw.api.modulator import Modulation
from escape_hw.errors import DeviceError, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.devices import StageConfig

#: Tables may differ from what was written by this share of the travel: the controller rounds.
_TABLE_TOLERANCE = 1e-5
#: A circle is measured over so many turns and samples of each, and corrected so often; slower ones are not.
_TURNS, _SAMPLES, _ROUNDS, _SLOWEST_HZ = 4, 32, 3, 0.5
#: Errors below this many radians count as none: the sensors' noise.
_NOISE_RAD = 2e-8
#: What the start of a circle shakes has settled after this many seconds.
_SETTLING_S = 0.1

AxisResponse = tuple[complex, complex]


class CircleGenerator:
    """The wave generators of one stage, whose controller is open with the servos on.

    Parameters
    ----------
    responses
        What is known of the axes by servo periods of a turn; measured ones are added.

    Attributes
    ----------
    error
        Error of the last circle measured, relative to its radius; ``None`` when none was.
    """

    def __init__(
        self,
        name: str,
        controller: E727,
        stage: StageConfig,
        travel: AxisTravel,
        responses: dict[int, AxisResponse],
        sleep: Callable[[float], None],
    ) -> None:
        self._name, self._controller, self._stage, self._travel = name, controller, stage, travel
        self._responses, self._sleep = responses, sleep
        self.error: float | None = None

    # ------------------------------------------------------------------ what is possible
    def achievable(self, want: Modulation) -> Modulation:
        """The modulation nearest to ``want`` that the generators' clock allows.

        Raises
        ------
        SettingRejected
            The frequency is too high, or the radius exceeds the travel.
        """
        turn, servo_s = self._timing(want), self._travel.servo_s
        if turn.servo_periods < self._stage.min_points:
            raise SettingRejected(
                self._name,
                f"frequency_hz is {want.frequency_hz:g}; it does up to "
                f"{1 / (self._stage.min_points * servo_s):g} Hz (wave generator's clock "
                f"{servo_s * 1e6:g} us, stage.min_points)",
            )
        achieved = Modulation(want.radius_rad, turn.frequency_hz(servo_s), want.centre_rad)
        self._waves(achieved, turn, self._response(turn))
        return achieved

    def _timing(self, modulation: Modulation) -> CycleTiming:
        return nearest_timing(modulation.frequency_hz, self._travel.servo_s, self._stage.max_points)

    def _waves(
        self, modulation: Modulation, turn: CycleTiming, response: AxisResponse
    ) -> NDArray[np.float64]:
        """Targets of both axes ``(points, 2)`` in the controller's unit, within its limits."""
        tilt = circle_targets(turn, response) * modulation.radius_rad + np.array(modulation.centre_rad)
        waves = self._travel.positions(tilt)
        if turn.points > MAX_POINTWISE:
            # What the controller draws itself has its phase to a point only.
            sine_tables = [evaluate_sine_table(turn, fit_sine_table(turn, waves[:, axis])) for axis in (0, 1)]
            waves = np.stack(sine_tables, axis=1)
        lower, upper = self._travel.lower, self._travel.upper
        if (waves < lower).any() or (waves > upper).any():
            raise SettingRejected(
                self._name,
                f"{modulation}: an axis would have to go to {waves.min():.4g} .. {waves.max():.4g}; "
                f"the controller's limits are {lower.max():.4g} .. {upper.min():.4g} (its units)",
            )
        return waves

    # ------------------------------------------------------------------ turning
    def turn(self, modulation: Modulation) -> None:
        """Turn as :meth:`achievable` returns, and correct until the circle is round.

        Raises
        ------
        DeviceError
            It does not turn, or not in that circle.
        """
        turn = self._timing(modulation)
        response = self._response(turn)
        self.error = None
        for _ in range(_ROUNDS):
            self._start_generators(modulation, turn, response)
            if not self._is_measurable(modulation):
                return
            measured = self._measure(modulation, turn)
            pairs = zip(measured, response, strict=True)
            self.error = max(abs(available / known - 1) for available, known in pairs)
            if self.error <= max(self._stage.circle_tolerance, _NOISE_RAD / modulation.radius_rad):
                return
            response = self._responses[turn.servo_periods] = measured
        raise DeviceError(
            self._name,
            f"draws {modulation} with an error of {self.error:.1%} of the radius after {_ROUNDS} "
            "corrections; is the mirror's load too high for this frequency? The limit is "
            "stage.circle_tolerance",
        )

    def stop(self) -> None:
        """Stop both axes where they are, and the trigger."""
        self._controller.clear_error()
        if any(self._controller.running()):
            self._controller.stop()
        self._controller.clear_trigger()

    def _start_generators(self, modulation: Modulation, turn: CycleTiming, response: AxisResponse) -> None:
        """Write both tables, read them back, go to their start, and start both axes at once."""
        controller, stage = self._controller, self._stage
        waves = self._waves(modulation, turn, response)
        self.stop()
        for axis in (0, 1):
            self._write_table(axis + 1, turn, waves[:, axis])
        controller.set_generators(turn.rate)
        controller.move_and_wait(waves[0], stage.settle_s, self._sleep)
        if stage.trigger_line:
            point = (stage.trigger_point - 1) % turn.points + 1
            controller.set_trigger(stage.trigger_line, stage.trigger_mode, point, turn.points)
        controller.start()
        if not all(controller.running()):
            raise DeviceError(
                self._name,
                "confirmed the start of its wave generators, but they do not run; see WGO? and ERR?",
            )

    def _write_table(self, table: int, turn: CycleTiming, wave: NDArray[np.float64]) -> None:
        if turn.points <= MAX_POINTWISE:
            self._controller.write_points(table, wave)
        else:
            self._controller.write_sine(table, turn, fit_sine_table(turn, wave))
        held = self._controller.table(table, turn.points)
        worst = float(np.abs(held - wave).max())
        if worst > _TABLE_TOLERANCE * float(np.max(self._travel.upper - self._travel.lower)):
            raise DeviceError(
                self._name,
                f"holds another wave in table {table} than was written (off by {worst:g} of its "
                "units); its WAV command differs from the manual's, see the bench checklist",
            )

    # ------------------------------------------------------------------ the circle's truth
    def _response(self, turn: CycleTiming) -> AxisResponse:
        """What the axes are known to make of a circle: measured, from the table, or nothing."""
        if turn.servo_periods in self._responses:
            return self._responses[turn.servo_periods]
        rows = self._stage.corrections if self._stage.correction_source != "none" else ()
        frequency = turn.frequency_hz(self._travel.servo_s)
        near = [row for row in rows if abs(row[0] / frequency - 1) < 0.005]
        if not near and self._stage.correction_source == "table":
            available = ", ".join(f"{row[0]:g}" for row in rows)
            raise SettingRejected(
                self._name,
                f"frequency_hz is {frequency:.6g}, and stage.corrections has rows "
                f"for {available} Hz only; 'recorder' measures others",
            )
        return response_from_row(near[0]) if near else (1 + 0j, 1 + 0j)

    def _is_measurable(self, modulation: Modulation) -> bool:
        """Whether the circle is checked with the recorder."""
        is_moving = modulation.radius_rad > 0 and modulation.frequency_hz >= _SLOWEST_HZ
        return self._stage.correction_source == "recorder" and is_moving

    def _measure(self, modulation: Modulation, turn: CycleTiming) -> AxisResponse:
        """Amplitude and phase of both axes relative to their targets."""
        self._sleep(max(_SETTLING_S, 1 / modulation.frequency_hz))
        found, _ = fit_phasors(*self._record(turn))
        if (np.abs(found[2:]) == 0).any():
            raise DeviceError(
                self._name, "recorded targets that do not move; see DRC? for the recorder's options"
            )
        x, y = (complex(place / target) for place, target in zip(found[:2], found[2:], strict=True))
        return x, y

    def _record(self, turn: CycleTiming) -> tuple[NDArray[np.float64], float]:
        """Some turns of positions and targets ``(samples, 4)``, and how many samples a turn has."""
        rate = max(1, turn.servo_periods // _SAMPLES)
        samples_per_turn = turn.servo_periods / rate
        points = round(_TURNS * samples_per_turn)
        return self._controller.record(points, rate, self._sleep, self._travel.servo_s), samples_per_turn

    def read_modulation(self) -> Modulation | None:
        """A running modulation found on the controller, from tables and recorder; moves nothing."""
        if not all(self._controller.running()):
            return None
        turn, waves = self._controller.read_waves()
        frequency = turn.frequency_hz(self._travel.servo_s)
        records, samples_per_turn = np.stack(waves, axis=1), float(turn.points)
        if frequency >= _SLOWEST_HZ:
            # The motion of the axes, not the command in the tables.
            records, samples_per_turn = self._record(turn)
        found, means = fit_phasors(records[:, :2], samples_per_turn)
        centre = self._travel.tilts(means)
        radii = np.abs(found * self._travel.gain) * self._travel.unit_rad
        return Modulation(float(radii.mean()), frequency, (float(centre[0]), float(centre[1])))

    def corrections(self) -> list[list[float]]:
        """What was measured, as rows of ``stage.corrections``."""
        rows = []
        for servo_periods, response in sorted(self._responses.items()):
            words = response_to_row(1 / (servo_periods * self._travel.servo_s), response)
            rows.append([float(f"{value:.5g}") for value in words])
        return rows
