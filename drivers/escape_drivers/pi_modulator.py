"""Driver ``pi-e727``: PI's E-727 controller with an S-330 tip-tilt platform, for a modulated pyramid."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_drivers import pi_circle
from escape_drivers.pi_circle import Turn
from escape_drivers.pi_controller import E727
from escape_drivers.pi_gcs import Garbled
from escape_drivers.pi_link import Link
from escape_drivers.pi_transports import Transport
from escape_drivers.pi_wire import make_transport
from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
from escape_hw.errors import ConfigError, DeviceError, DeviceLost, SettingRejected

if TYPE_CHECKING:
    from escape_hw.config.device_models import ModulatorConfig
    from escape_hw.config.models import SystemConfig

log = logging.getLogger(__name__)

#: How often a stage on its way is asked whether it has arrived, in seconds.
_POLL_S = 0.01
#: Tables may differ from what was written by this share of the travel: the controller rounds.
_SAME = 1e-5
#: A circle is measured over so many turns and samples of each, and corrected so often; slower ones are not.
_TURNS, _SAMPLES, _ROUNDS, _SLOWEST_HZ = 4, 32, 3, 0.5
#: Errors below this many radians count as none: the sensors' noise.
_NOISE_RAD = 2e-8


def make_modulator(name: str, config: SystemConfig, shared: dict[str, object]) -> PiModulator:
    """Entry point ``pi-e727``.

    Raises
    ------
    ConfigError
        The system has no modulator.
    """
    section = config.devices.modulator
    if section is None:
        raise ConfigError(f"system {config.system.name!r} has no [devices.modulator] section")
    return PiModulator(name, section, lambda: make_transport(section, config, shared))


class PiModulator(TipTiltModulator):
    """The stage, driven in the order that its maker and users give.

    Opening: generators stopped, servos off, auto-zero, no volts, servos on, centre. Closing: generators
    stopped, centre, servos off, no volts. A turning circle is measured with the controller's recorder
    and made round; both axes start in the same servo cycle.

    Parameters
    ----------
    name
        In messages.
    section
        Configuration.
    connect
        Makes the wire.
    sleep
        Waits.
    """

    def __init__(
        self,
        name: str,
        section: ModulatorConfig,
        connect: Callable[[], Transport],
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(name)
        self._section, self._connect, self._sleep = section, connect, sleep
        self._stage = section.stage
        self._controller: E727 | None = None
        self._info: ModulatorInfo | None = None
        self._now: Modulation | None = None
        #: Response of the axes by servo periods of a turn, as measured.
        self._responses: dict[int, tuple[complex, complex]] = {}
        self._error = 0.0
        self._unit, self._servo_s = 1e-6, 50e-6
        self._lower, self._upper = np.zeros(2), np.zeros(2)

    # ------------------------------------------------------------------ identity
    @property
    def info(self) -> ModulatorInfo:
        """Identity and reach, as the controller tells them."""
        if self._info is None:
            self.require_open()
            raise DeviceError(self.name, "has told nothing of itself yet")
        return self._info

    @property
    def modulation(self) -> Modulation | None:
        """The modulation in force; the controller is asked whether it still turns."""
        if self._now is None or self._controller is None:
            return None
        if all(self._controller.running()):
            return self._now
        log.warning("%s: no longer turns; somebody or something else stopped it", self.name)
        self._now = None
        return None

    @property
    def _centre(self) -> NDArray[np.float64]:
        """Middle of the travel ``(2,)``, controller's units."""
        return 0.5 * (self._lower + self._upper)

    # ------------------------------------------------------------------ opening and closing
    def _open(self) -> None:
        controller = self._meet()
        with self._understood():
            self._start_up(controller)

    def _meet(self) -> E727:
        """Connect and learn what is there; moves nothing."""
        link = Link(self.name, self._connect(), self._section.wire.timeout_s)
        controller = self._controller = E727(link, self._stage.axes)
        link.open()
        with self._understood():
            self._check_identity(controller)
            self._unit, self._servo_s = controller.unit_rad(), controller.servo_period_s()
            lower, upper = controller.limits()
        self._lower, self._upper = np.array(lower), np.array(upper)
        if not (self._lower < self._upper).all():
            raise DeviceError(
                self.name, f"reports limits {lower} to {upper}; see TMN?, TMX? and the head's cable"
            )
        reach = float(np.min(self._upper - self._lower)) / 2 * self._unit
        simulated = "emulated" in link.identity
        self._info = ModulatorInfo(
            f"PI {controller.model} with {controller.stages()[0]}",
            controller.serial,
            min(reach, self._section.max_tilt_rad),
            simulated,
        )
        return controller

    def _check_identity(self, controller: E727) -> None:
        want, found = self._section.serial, controller.serial
        if want and want != found:
            raise DeviceError(
                self.name,
                f"found the controller with serial number {found!r}, not {want!r}; see devices.modulator",
            )
        present = controller.channels()
        missing = [axis for axis in self._stage.axes if axis not in present]
        if missing:
            raise DeviceError(
                self.name,
                f"has no axis {missing[0]!r}, only {', '.join(present)}; see devices.modulator.stage.axes",
            )
        for axis, stage in zip(self._stage.axes, controller.stages(), strict=True):
            if "NOSTAGE" in stage.upper():
                raise DeviceError(
                    self.name, f"axis {axis} carries no stage; see devices.modulator.stage.axes"
                )

    def _start_up(self, controller: E727) -> None:
        """The order of E727T0005 and of those who use it: a servo is never switched on unzeroed."""
        if any(controller.running()):
            log.warning("%s: was turning when it was opened; stopped", self.name)
            controller.stop()
        controller.clear_trigger()
        zero = self._stage.auto_zero
        wanted = zero == "always" or (zero == "needed" and not all(controller.zeroed()))
        if wanted or not all(controller.servos()):
            controller.set_servo(False)
            if wanted:
                self._auto_zero(controller)
            controller.set_volts(0.0)
            controller.set_servo(True)
        self._now = None
        self._go(self._centre)

    def _auto_zero(self, controller: E727) -> None:
        """One axis after the other, each until it is done."""
        for number, axis in enumerate(self._stage.axes):
            log.warning("%s: auto-zero of axis %s sweeps its full range", self.name, axis)
            controller.start_auto_zero(axis, self._stage.auto_zero_v)
            deadline = time.monotonic() + self._stage.auto_zero_s
            while not controller.zeroed()[number]:
                # A failure shows in the error, which the next command would trip over.
                if time.monotonic() > deadline:
                    raise DeviceError(
                        self.name,
                        f"auto-zero of axis {axis} has not ended after {self._stage.auto_zero_s:g} s; "
                        "is the platform free, its cable plugged in? "
                        "devices.modulator.stage.auto_zero_s is the longest wait",
                    )
                controller.check_error(f"ATZ {axis}")
                self._sleep(5 * _POLL_S)

    def _close(self) -> None:
        controller, self._controller, self._now, self._info = self._controller, None, None, None
        if controller is None:
            return
        try:
            if controller.link.alive:
                controller.set_servo(False)
                controller.set_volts(0.0)
        except DeviceLost as gone:
            log.warning("%s: lost while closing: %s", self.name, gone)
        finally:
            controller.link.close()

    def _abandon(self) -> None:
        controller, self._controller, self._info = self._controller, None, None
        if controller is not None:
            controller.link.close()

    # ------------------------------------------------------------------ modulating
    def _check(self, want: Modulation) -> Modulation:
        shortest_s = self._stage.min_points * self._servo_s
        turn = pi_circle.nearest_turn(want.frequency_hz, self._servo_s, self._stage.max_points)
        if turn.steps < self._stage.min_points or turn.rate > 1_000_000:
            raise SettingRejected(
                self.name,
                f"frequency_hz is {want.frequency_hz:g}; it does up to {1 / shortest_s:g} Hz, its "
                f"wave generator's clock is {self._servo_s * 1e6:g} us",
            )
        made = Modulation(want.radius_rad, turn.frequency_hz(self._servo_s), want.centre_rad)
        self._require_reach(self._waves(made, turn, self._response(turn)), made)
        return made

    def _modulate(self, modulation: Modulation) -> None:
        controller = self._require_controller()
        try:
            with self._understood():
                self._turn(controller, modulation)
        except DeviceLost:
            raise
        except DeviceError as failure:
            # A circle that is not the one asked for is worse than none.
            self._tidy(self._park, failure)
            raise

    def _turn(self, controller: E727, modulation: Modulation) -> None:
        turn = pi_circle.nearest_turn(modulation.frequency_hz, self._servo_s, self._stage.max_points)
        response = self._response(turn)
        for _ in range(_ROUNDS):
            self._play(controller, modulation, turn, response)
            if not self._measurable(modulation):
                break
            measured, self._error = self._measure(controller, modulation, turn, response)
            if self._error * modulation.radius_rad <= max(
                self._stage.round_within * modulation.radius_rad, _NOISE_RAD
            ):
                break
            response = self._responses[turn.steps] = measured
        else:
            raise DeviceError(
                self.name,
                f"draws {modulation} with an error of {self._error:.1%} of the radius after {_ROUNDS} "
                "corrections; is the mirror's load too high for this frequency? "
                "devices.modulator.stage.round_within is the limit",
            )
        self._now = modulation

    def _play(
        self, controller: E727, modulation: Modulation, turn: Turn, response: tuple[complex, complex]
    ) -> None:
        """Write both tables, read them back, go to their start, and start both axes at once."""
        waves = self._waves(modulation, turn, response)
        self._require_reach(waves, modulation)
        if any(controller.running()):
            controller.stop()
        self._now = None
        for table in (0, 1):
            self._write(controller, table + 1, turn, waves[:, table])
        controller.set_generators(turn.rate)
        self._go(waves[0])
        if self._stage.trigger_line:
            point = (self._stage.trigger_point - 1) % turn.points + 1
            controller.set_trigger(self._stage.trigger_line, self._stage.trigger_mode, point, turn.points)
        controller.start()
        if not all(controller.running()):
            raise DeviceError(self.name, "confirmed the start of its wave generators, but they do not run")

    def _waves(
        self, modulation: Modulation, turn: Turn, response: tuple[complex, complex]
    ) -> NDArray[np.float64]:
        """Targets of both axes ``(points, 2)`` in the controller's units."""
        tilt = pi_circle.circle(turn, response) * modulation.radius_rad + np.array(modulation.centre_rad)
        waves = self._centre + tilt / np.array(self._stage.axis_gain) / self._unit
        if turn.points <= pi_circle.EXACT:
            return np.asarray(waves, np.float64)
        # What the controller draws itself has its phase to a point only.
        drawn = [pi_circle.sine_points(turn, pi_circle.sine_of(turn, waves[:, axis])) for axis in (0, 1)]
        return np.stack(drawn, axis=1)

    def _write(self, controller: E727, table: int, turn: Turn, wave: NDArray[np.float64]) -> None:
        if turn.points <= pi_circle.EXACT:
            controller.write_points(table, wave)
        else:
            controller.write_sine(table, turn, pi_circle.sine_of(turn, wave))
        held = controller.table(table, turn.points)
        worst = float(np.abs(held - wave).max())
        if worst > _SAME * float(np.max(self._upper - self._lower)):
            raise DeviceError(
                self.name,
                f"holds another wave in table {table} than was written (off by {worst:g} of its "
                "units); its WAV command differs from the manual's, see the bench checklist",
            )

    def _require_reach(self, waves: NDArray[np.float64], modulation: Modulation) -> None:
        if (waves < self._lower).any() or (waves > self._upper).any():
            raise SettingRejected(
                self.name,
                f"{modulation}: an axis would have to go to {waves.min():.4g} .. {waves.max():.4g}; "
                f"the controller's limits are {self._lower.max():.4g} .. {self._upper.min():.4g} (its units)",
            )

    # ------------------------------------------------------------------ the circle's truth
    def _response(self, turn: Turn) -> tuple[complex, complex]:
        """What the axes are known to make of a circle: measured, from the table, or nothing."""
        if turn.steps in self._responses:
            return self._responses[turn.steps]
        rows = self._stage.corrections if self._stage.correct != "none" else ()
        frequency = turn.frequency_hz(self._servo_s)
        near = [row for row in rows if abs(row[0] / frequency - 1) < 0.005]
        return pi_circle.from_words(near[0]) if near else (1 + 0j, 1 + 0j)

    def _measurable(self, modulation: Modulation) -> bool:
        """Whether the recorder is to look at this circle."""
        turning = modulation.radius_rad > 0 and modulation.frequency_hz >= _SLOWEST_HZ
        return self._stage.correct == "recorder" and turning

    def _measure(
        self, controller: E727, modulation: Modulation, turn: Turn, response: tuple[complex, complex]
    ) -> tuple[tuple[complex, complex], float]:
        """The axes' response, and the largest error of the circle relative to its radius."""
        turn_s = 1 / modulation.frequency_hz
        # What the start shook has settled by then.
        self._sleep(max(0.1, turn_s))
        rate = max(1, turn.steps // _SAMPLES)
        per_turn = turn.steps / rate
        track = controller.record(round(_TURNS * per_turn), rate, self._sleep, self._servo_s)
        found, _ = pi_circle.phasors(track, per_turn)
        if (np.abs(found[2:]) == 0).any():
            raise DeviceError(
                self.name, "recorded targets that stand still; see DRC? for what its recorder offers"
            )
        x, y = (complex(place / target) for place, target in zip(found[:2], found[2:], strict=True))
        return (x, y), max(abs(x / response[0] - 1), abs(y / response[1] - 1))

    # ------------------------------------------------------------------ parking and asking
    def _park(self) -> None:
        controller = self._require_controller()
        with self._understood():
            if any(controller.running()):
                controller.stop()
            self._now = None
            controller.clear_trigger()
            self._go(self._centre)

    def _go(self, places: NDArray[np.float64]) -> None:
        """Move both axes and wait until they are there."""
        controller = self._require_controller()
        controller.move([float(place) for place in places])
        deadline = time.monotonic() + self._stage.settle_s
        while not controller.on_target():
            if time.monotonic() > deadline:
                here = ", ".join(f"{place:.2f}" for place in controller.places())
                raise DeviceError(
                    self.name,
                    f"has not settled at {', '.join(f'{place:.2f}' for place in places)} within "
                    f"{self._stage.settle_s:g} s, it is at {here} (its units); is the platform free to move?",
                )
            self._sleep(_POLL_S)

    def _status(self) -> ModulatorStatus:
        controller = self._require_controller()
        with self._understood():
            tilt = (
                (np.array(controller.places()) - self._centre) * self._unit * np.array(self._stage.axis_gain)
            )
            servos, zeroed = controller.servos(), controller.zeroed()
            modulation = self.modulation or self._left_turning(controller)
        details: dict[str, Any] = {
            "identity": controller.link.identity,
            "servo": servos,
            "auto_zeroed": zeroed,
            "travel": {"lower": self._lower.tolist(), "upper": self._upper.tolist(), "unit_rad": self._unit},
            "recoveries": controller.link.recoveries,
            "circle_error": self._error if self._now else None,
            "corrections": self._corrections(),
        }
        return ModulatorStatus(self.info, modulation, (float(tilt[0]), float(tilt[1])), details)

    def _left_turning(self, controller: E727) -> Modulation | None:
        """A modulation that somebody left in force, read from the controller's tables."""
        if not all(controller.running()):
            return None
        turn, waves = controller.played()
        places = [(waves[k] - self._centre[k]) * self._unit * self._stage.axis_gain[k] for k in (0, 1)]
        spans = [
            float(np.ptp(place)) / 2 * abs(value)
            for place, value in zip(places, self._response(turn), strict=True)
        ]
        middles = [float(place.max() + place.min()) / 2 for place in places]
        frequency = turn.frequency_hz(self._servo_s)
        return Modulation(sum(spans) / 2, frequency, (middles[0], middles[1]))

    def _corrections(self) -> list[list[float]]:
        """What was measured, as rows of ``devices.modulator.stage.corrections``."""
        rows = []
        for steps, response in sorted(self._responses.items()):
            words = pi_circle.in_words(1 / (steps * self._servo_s), response)
            rows.append([float(f"{value:.5g}") for value in words])
        return rows

    def _look(self) -> ModulatorStatus:
        try:
            self._meet()
            return self._status()
        finally:
            self._abandon()

    def _release(self) -> bool:
        controller, self._controller, self._now, self._info = self._require_controller(), None, None, None
        controller.link.close()
        return True

    # ------------------------------------------------------------------ tools
    def _require_controller(self) -> E727:
        if self._controller is None:
            self.require_open()
            raise DeviceLost(self.name, "not connected")
        return self._controller

    @contextmanager
    def _understood(self) -> Iterator[None]:
        """What the codec could not make sense of becomes this device's error."""
        try:
            yield
        except Garbled as error:
            raise DeviceError(
                self.name, f"said something unexpected: {error}; see the bench checklist"
            ) from error
