"""Makes a PI stage turn in a circle, looks whether it is one, and makes it rounder."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_drivers import pi_circle
from escape_drivers.pi_circle import Turn
from escape_drivers.pi_controller import E727
from escape_drivers.pi_travel import Travel
from escape_hw.api.modulator import Modulation
from escape_hw.errors import DeviceError, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.modulator_models import StageConfig

#: Tables may differ from what was written by this share of the travel: the controller rounds.
_SAME = 1e-5
#: A circle is measured over so many turns and samples of each, and corrected so often; slower ones are not.
_TURNS, _SAMPLES, _ROUNDS, _SLOWEST_HZ = 4, 32, 3, 0.5
#: Errors below this many radians count as none: the sensors' noise.
_NOISE_RAD = 2e-8
#: What the start of a circle shakes has settled after this many seconds.
_SHAKEN_S = 0.1

Response = tuple[complex, complex]


class Turning:
    """The wave generators of one stage.

    Parameters
    ----------
    name
        Of the device, for messages.
    controller
        Open, servos on.
    stage
        Configuration.
    travel
        Range and clock.
    responses
        What is known of the axes by servo periods of a turn; measured ones are added.
    sleep
        Waits.

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
        travel: Travel,
        responses: dict[int, Response],
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
            Too fast, or beyond the travel.
        """
        turn, servo_s = self._turn(want), self._travel.servo_s
        if turn.steps < self._stage.min_points:
            raise SettingRejected(
                self._name,
                f"frequency_hz is {want.frequency_hz:g}; it does up to "
                f"{1 / (self._stage.min_points * servo_s):g} Hz (wave generator's clock "
                f"{servo_s * 1e6:g} us, devices.modulator.stage.min_points)",
            )
        made = Modulation(want.radius_rad, turn.frequency_hz(servo_s), want.centre_rad)
        self._waves(made, turn, self._response(turn))
        return made

    def _turn(self, modulation: Modulation) -> Turn:
        return pi_circle.nearest_turn(modulation.frequency_hz, self._travel.servo_s, self._stage.max_points)

    def _waves(self, modulation: Modulation, turn: Turn, response: Response) -> NDArray[np.float64]:
        """Targets of both axes ``(points, 2)`` in the controller's unit, within its limits."""
        tilt = pi_circle.circle(turn, response) * modulation.radius_rad + np.array(modulation.centre_rad)
        waves = self._travel.places(tilt)
        if turn.points > pi_circle.EXACT:
            # What the controller draws itself has its phase to a point only.
            drawn = [pi_circle.sine_points(turn, pi_circle.sine_of(turn, waves[:, axis])) for axis in (0, 1)]
            waves = np.stack(drawn, axis=1)
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
        """Turn, and correct until the circle is round.

        Parameters
        ----------
        modulation
            From :meth:`achievable`.

        Raises
        ------
        DeviceError
            It does not turn, or not in that circle.
        """
        turn = self._turn(modulation)
        response = self._response(turn)
        self.error = None
        for _ in range(_ROUNDS):
            self._play(modulation, turn, response)
            if not self._measurable(modulation):
                return
            measured = self._measure(modulation, turn)
            pairs = zip(measured, response, strict=True)
            self.error = max(abs(there / known - 1) for there, known in pairs)
            if self.error <= max(self._stage.round_within, _NOISE_RAD / modulation.radius_rad):
                return
            response = self._responses[turn.steps] = measured
        raise DeviceError(
            self._name,
            f"draws {modulation} with an error of {self.error:.1%} of the radius after {_ROUNDS} "
            "corrections; is the mirror's load too high for this frequency? The limit is "
            "devices.modulator.stage.round_within",
        )

    def stop(self) -> None:
        """Stop both axes where they are, and the trigger."""
        self._controller.clear_error()
        if any(self._controller.running()):
            self._controller.stop()
        self._controller.clear_trigger()

    def _play(self, modulation: Modulation, turn: Turn, response: Response) -> None:
        """Write both tables, read them back, go to their start, and start both axes at once."""
        controller, stage = self._controller, self._stage
        waves = self._waves(modulation, turn, response)
        self.stop()
        for axis in (0, 1):
            self._write(axis + 1, turn, waves[:, axis])
        controller.set_generators(turn.rate)
        controller.go(waves[0], stage.settle_s, self._sleep)
        if stage.trigger_line:
            point = (stage.trigger_point - 1) % turn.points + 1
            controller.set_trigger(stage.trigger_line, stage.trigger_mode, point, turn.points)
        controller.start()
        if not all(controller.running()):
            raise DeviceError(
                self._name,
                "confirmed the start of its wave generators, but they do not run; see WGO? and ERR?",
            )

    def _write(self, table: int, turn: Turn, wave: NDArray[np.float64]) -> None:
        if turn.points <= pi_circle.EXACT:
            self._controller.write_points(table, wave)
        else:
            self._controller.write_sine(table, turn, pi_circle.sine_of(turn, wave))
        held = self._controller.table(table, turn.points)
        worst = float(np.abs(held - wave).max())
        if worst > _SAME * float(np.max(self._travel.upper - self._travel.lower)):
            raise DeviceError(
                self._name,
                f"holds another wave in table {table} than was written (off by {worst:g} of its "
                "units); its WAV command differs from the manual's, see the bench checklist",
            )

    # ------------------------------------------------------------------ the circle's truth
    def _response(self, turn: Turn) -> Response:
        """What the axes are known to make of a circle: measured, from the table, or nothing."""
        if turn.steps in self._responses:
            return self._responses[turn.steps]
        rows = self._stage.corrections if self._stage.correct != "none" else ()
        frequency = turn.frequency_hz(self._travel.servo_s)
        near = [row for row in rows if abs(row[0] / frequency - 1) < 0.005]
        if not near and self._stage.correct == "table":
            there = ", ".join(f"{row[0]:g}" for row in rows)
            raise SettingRejected(
                self._name,
                f"frequency_hz is {frequency:.6g}, and devices.modulator.stage.corrections has rows "
                f"for {there} Hz only; 'recorder' measures others",
            )
        return pi_circle.from_words(near[0]) if near else (1 + 0j, 1 + 0j)

    def _measurable(self, modulation: Modulation) -> bool:
        """Whether the recorder is to look at this circle."""
        turning = modulation.radius_rad > 0 and modulation.frequency_hz >= _SLOWEST_HZ
        return self._stage.correct == "recorder" and turning

    def _measure(self, modulation: Modulation, turn: Turn) -> Response:
        """Amplitude and phase of both axes relative to their targets."""
        self._sleep(max(_SHAKEN_S, 1 / modulation.frequency_hz))
        found, _ = pi_circle.phasors(*self._record(turn))
        if (np.abs(found[2:]) == 0).any():
            raise DeviceError(
                self._name, "recorded targets that stand still; see DRC? for what its recorder offers"
            )
        x, y = (complex(place / target) for place, target in zip(found[:2], found[2:], strict=True))
        return x, y

    def _record(self, turn: Turn) -> tuple[NDArray[np.float64], float]:
        """Some turns of positions and targets ``(samples, 4)``, and how many samples a turn has."""
        rate = max(1, turn.steps // _SAMPLES)
        per_turn = turn.steps / rate
        points = round(_TURNS * per_turn)
        return self._controller.record(points, rate, self._sleep, self._travel.servo_s), per_turn

    def found_turning(self) -> Modulation | None:
        """A modulation that somebody left in force, by tables and recorder; moves nothing."""
        if not all(self._controller.running()):
            return None
        turn, waves = self._controller.played()
        frequency = turn.frequency_hz(self._travel.servo_s)
        track, per_turn = np.stack(waves, axis=1), float(turn.points)
        if frequency >= _SLOWEST_HZ:
            # Not what the tables ask for, but what the axes make of it.
            track, per_turn = self._record(turn)
        found, means = pi_circle.phasors(track[:, :2], per_turn)
        centre = self._travel.tilts(means)
        radii = np.abs(found * self._travel.gain) * self._travel.unit_rad
        return Modulation(float(radii.mean()), frequency, (float(centre[0]), float(centre[1])))

    def corrections(self) -> list[list[float]]:
        """What was measured, as rows of ``devices.modulator.stage.corrections``."""
        rows = []
        for steps, response in sorted(self._responses.items()):
            words = pi_circle.in_words(1 / (steps * self._travel.servo_s), response)
            rows.append([float(f"{value:.5g}") for value in words])
        return rows
