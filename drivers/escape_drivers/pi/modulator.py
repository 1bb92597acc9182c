"""Driver ``pi-e727``: PI's E-727 controller with an S-330 tip-tilt platform.

For a modulated pyramid; start-up and shut-down sequence.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from pydantic import Field

from escape_drivers.common.options import keywords_of, require_serial
from escape_drivers.pi.circle import AxisResponse, CircleGenerator
from escape_drivers.pi.controller import E727
from escape_drivers.pi.gcs import MalformedReply
from escape_drivers.pi.link import GcsLink
from escape_drivers.pi.transports import Transport, make_transport
from escape_drivers.pi.travel import AxisTravel, read_travel
from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
from escape_hw.config.devices import LargestTilt, StageConfig, WireConfig
from escape_hw.config.options import parse_options
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import DeviceError, DeviceLost

if TYPE_CHECKING:
    from escape_hw.config.devices import ModulatorConfig

log = logging.getLogger(__name__)

#: Interval of queries for the end of auto-zero, in seconds.
_POLL_S = 0.05


def start_up(
    name: str, controller: E727, stage: StageConfig, travel: AxisTravel, sleep: Callable[[float], None]
) -> None:
    """Generators stopped, servos off, auto-zero, no volts, servos on, centre (order of those who use it).

    A servo is never switched on before auto-zero: its sensor would be off by an unknown amount. Where
    auto-zero was done and the servos are on, nothing but the generators and the centre is touched.

    Raises
    ------
    DeviceError
        Refused, not in time, or not at the centre in the end.
    """
    if any(controller.running()):
        log.warning("%s: was turning when it was opened; stopped", name)
        controller.stop()
    controller.clear_trigger()
    zero = stage.auto_zero == "always" or (stage.auto_zero == "needed" and not all(controller.auto_zeroed()))
    if zero or not all(controller.servo_states()):
        controller.set_servo(False)
        if not zero and not all(controller.auto_zeroed()):
            log.warning("%s: servos on without auto-zero, as configured: places may be off", name)
        if zero:
            _auto_zero(name, controller, stage, sleep)
        controller.set_volts(0.0)
        controller.set_servo(True)
    controller.move_and_wait(travel.centre, stage.settle_s, sleep)


def _auto_zero(name: str, controller: E727, stage: StageConfig, sleep: Callable[[float], None]) -> None:
    """One axis after the other, each until it is done."""
    for number, axis in enumerate(stage.axes):
        log.warning("%s: auto-zero of axis %s sweeps its full range", name, axis)
        controller.start_auto_zero(axis, stage.auto_zero_v)
        deadline = time.monotonic() + stage.auto_zero_s
        while not controller.auto_zeroed()[number]:
            # A failure shows in the pending error only, which the next command would trip over.
            controller.check_error(f"ATZ {axis}")
            if time.monotonic() > deadline:
                raise DeviceError(
                    name,
                    f"auto-zero of axis {axis} has not ended after {stage.auto_zero_s:g} s; is the "
                    "platform free to move, its cable plugged in? The longest wait is "
                    "stage.auto_zero_s",
                )
            sleep(_POLL_S)


#: Largest tilt of a stage that is opened without a system file, radians of mirror.
CAUTIOUS_TILT_RAD = 1e-3
#: State of a stage after the link is lost.
_UNREACHABLE_NOTE = (
    "the stage continues its motion; opening it again stops and centres it, switching off its power "
    "releases it"
)


class PiSettings(WireConfig):
    """Settings of a stage: the keys of its connection, and these.

    Parameters
    ----------
    max_tilt_rad
        Largest tilt of the mirror from its centre, radians; the travel that the stage reports limits it too.
    stage
        Axes and correction of the circle: a :class:`~escape_hw.config.devices.StageConfig` or its keys.
    """

    max_tilt_rad: LargestTilt = CAUTIOUS_TILT_RAD
    stage: StageConfig = Field(default_factory=StageConfig)


class _Connection(NamedTuple):
    """What there is while the controller is connected."""

    controller: E727
    travel: AxisTravel
    circle_generator: CircleGenerator
    info: ModulatorInfo


class PiModulator(TipTiltModulator):
    """The stage, driven in the order that its maker and users give.

    Opening: generators stopped, servos off, auto-zero, no volts, servos on, centre. Closing: generators
    stopped, centre, servos off, no volts. A turning circle is measured with the controller's recorder
    and made round; both axes start in the same servo cycle.

    When the link is lost the stage continues its motion and cannot be reached: every call raises this at
    once, and opening anew stops and centres it.

    Parameters
    ----------
    serial
        Serial number of the controller; one with another number is refused.
    name
        Name in messages.
    connect
        Makes the transport; absent: by the settings.
    sleep
        Waits for so many seconds.
    **settings
        Fields of :class:`PiSettings`, such as ``host``.

    Raises
    ------
    ConfigError
        The serial number is missing, or a setting is unknown or wrong.
    """

    def __init__(
        self,
        serial: str | int,
        *,
        name: str = "modulator",
        connect: Callable[[], Transport] | None = None,
        sleep: Callable[[float], None] = time.sleep,
        **settings: Any,
    ) -> None:
        super().__init__(name)
        self._serial, self._sleep = require_serial("serial", serial), sleep
        self._settings = wire = parse_options(PiSettings, name, settings, keywords_of(type(self)))
        self._stage = wire.stage
        self._connect = connect or (lambda: make_transport(wire, self._serial, {}, DeviceContext(name)))
        self._connection: _Connection | None = None
        self._modulation: Modulation | None = None
        #: Survives closing: the mirror on the stage stays the same.
        self._responses: dict[int, AxisResponse] = {}

    @classmethod
    def from_section(cls, section: ModulatorConfig, context: DeviceContext) -> Self:
        """The modulator of ``[devices.modulator]``; raises ``ConfigError`` as the class does."""
        return cls(
            require_serial(f"devices.{context.name}.serial", section.serial),
            name=context.name,
            max_tilt_rad=section.max_tilt_rad,
            stage=section.stage,
            connect=lambda: make_transport(section.wire, section.serial, section.options, context),
            **section.wire.model_dump(),
        )

    @property
    def info(self) -> ModulatorInfo:
        """Identity and travel, as the controller reports them."""
        return self._require_connection().info

    @property
    def modulation(self) -> Modulation | None:
        """The present modulation; the controller is asked whether it still runs."""
        if self._connection is None:
            return None
        # The state of a stage without a link is unknown.
        self._connection.controller.link.require_connected()
        if self._modulation is None:
            return None
        with self._translate_errors():
            if all(self._connection.controller.running()):
                return self._modulation
        log.warning("%s: no longer runs; it was not stopped by this driver", self.name)
        self._modulation = None
        return None

    # ------------------------------------------------------------------ opening and closing
    def _open(self) -> None:
        with self._open_connection() as connection:
            try:
                start_up(self.name, connection.controller, self._stage, connection.travel, self._sleep)
            except BaseException as failure:
                self._clean_up(lambda: self._abort_start_up(connection.controller), failure)
                raise
        self._connection = connection

    @contextmanager
    def _open_connection(self) -> Iterator[_Connection]:
        """Connect and learn what is there; moves nothing. Hangs up again when that, or the body, fails."""
        link = GcsLink(self.name, self._connect(), self._settings.timeout_s)
        try:
            link.open()
            controller = E727(link, self._stage.axes)
            with self._translate_errors():
                travel = read_travel(self.name, controller, self._serial, self._stage)
                model = f"PI {controller.model} with {controller.stage_names()[0]}"
                circle_generator = CircleGenerator(
                    self.name, controller, self._stage, travel, self._responses, self._sleep
                )
                reach = min(travel.reach_rad, self._settings.max_tilt_rad)
                info = ModulatorInfo(model, controller.serial, reach, "emulated" in link.identity)
                yield _Connection(controller, travel, circle_generator, info)
        except BaseException:
            link.close()
            raise

    def _close(self) -> None:
        connection, self._connection, self._modulation = self._connection, None, None
        if connection is None:
            return
        try:
            self._switch_off(connection.controller)
        finally:
            connection.controller.link.close()

    def _abort_start_up(self, controller: E727) -> None:
        """Stop an unfinished start-up, then switch off."""
        if controller.link.is_alive:
            controller.stop_all()
        self._switch_off(controller)

    def _switch_off(self, controller: E727) -> None:
        """Servos off and zero volts, unless the link was lost before."""
        if controller.link.is_alive:
            controller.set_servo(False)
            controller.set_volts(0.0)

    # ------------------------------------------------------------------ the hooks
    def _check(self, want: Modulation) -> Modulation:
        return self._require_connection().circle_generator.achievable(want)

    def _modulate(self, modulation: Modulation) -> None:
        connection = self._require_connection()
        self._modulation = None
        try:
            with self._translate_errors():
                connection.circle_generator.turn(modulation)
        except DeviceLost as lost:
            lost.add_note(_UNREACHABLE_NOTE)
            raise
        except DeviceError as failure:
            # A wrong circle is worse than none.
            self._clean_up(self._park, failure)
            raise
        self._modulation = modulation

    def _park(self) -> None:
        connection = self._require_connection()
        self._modulation = None
        try:
            with self._translate_errors():
                connection.circle_generator.stop()
                connection.controller.move_and_wait(
                    connection.travel.centre, self._stage.settle_s, self._sleep
                )
        except DeviceLost as lost:
            lost.add_note(_UNREACHABLE_NOTE)
            raise

    def _status(self) -> ModulatorStatus:
        with self._translate_errors():
            return self._read_status(self._require_connection())

    def _status_when_closed(self) -> ModulatorStatus:
        with self._open_connection() as connection:
            status = self._read_status(connection)
        connection.controller.link.close()
        return status

    def _read_status(self, connection: _Connection) -> ModulatorStatus:
        controller, travel = connection.controller, connection.travel
        tilt = travel.tilts(np.array(controller.positions()))
        modulation = self.modulation or connection.circle_generator.read_modulation()
        details: dict[str, Any] = {
            "identity": controller.link.identity,
            "servo": controller.servo_states(),
            "auto_zeroed": controller.auto_zeroed(),
            "travel": {
                "lower": travel.lower.tolist(),
                "upper": travel.upper.tolist(),
                "unit_rad": travel.unit_rad,
            },
            "recoveries": controller.link.recoveries,
            "circle_error": connection.circle_generator.error if self._modulation else None,
            "corrections": connection.circle_generator.corrections(),
        }
        return ModulatorStatus(connection.info, modulation, (float(tilt[0]), float(tilt[1])), details)

    def _release(self) -> bool:
        if self._settings.kind == "emulator":
            # It ends with the connection.
            return False
        connection, self._connection, self._modulation = self._require_connection(), None, None
        connection.controller.link.close()
        return True

    # ------------------------------------------------------------------ tools
    def _require_connection(self) -> _Connection:
        if self._connection is None:
            self.require_open()
            raise DeviceLost(self.name, "not connected; close it and open it again")
        return self._connection

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """What the codec could not make sense of becomes this device's error."""
        try:
            yield
        except MalformedReply as error:
            raise DeviceError(
                self.name, f"sent an unexpected reply: {error}; see the bench checklist"
            ) from error


#: Name of the entry point in version 0.1.0, which an environment installed then still has.
make_modulator = PiModulator
