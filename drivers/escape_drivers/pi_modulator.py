"""Driver ``pi-e727``: PI's E-727 controller with an S-330 tip-tilt platform, for a modulated pyramid."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from escape_drivers.pi_controller import E727
from escape_drivers.pi_gcs import Garbled
from escape_drivers.pi_link import Link
from escape_drivers.pi_start_up import shut_down, start_up
from escape_drivers.pi_transports import Transport
from escape_drivers.pi_travel import Travel, learn_travel
from escape_drivers.pi_turning import Response, Turning
from escape_drivers.pi_wire import make_transport
from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
from escape_hw.errors import ConfigError, DeviceError, DeviceLost

if TYPE_CHECKING:
    from escape_hw.config.device_models import ModulatorConfig
    from escape_hw.config.models import SystemConfig

log = logging.getLogger(__name__)

#: What becomes of a stage that nobody can reach.
_GOES_ON = "the stage goes on as it was; opening it again stops and centres it, cutting its power lets it go"


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


class _Connection:
    """What there is while the controller is connected."""

    def __init__(self, controller: E727, travel: Travel, turning: Turning, info: ModulatorInfo) -> None:
        self.controller, self.travel, self.turning, self.info = controller, travel, turning, info


class PiModulator(TipTiltModulator):
    """The stage, driven in the order that its maker and users give.

    Opening: generators stopped, servos off, auto-zero, no volts, servos on, centre. Closing: generators
    stopped, centre, servos off, no volts. A turning circle is measured with the controller's recorder
    and made round; both axes start in the same servo cycle.

    When the link is lost the stage goes on as it was, for nobody can reach it: every call says so at
    once, and opening anew stops and centres it.

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
        self._connection: _Connection | None = None
        self._now: Modulation | None = None
        #: Survives closing: the mirror on the stage stays the same.
        self._responses: dict[int, Response] = {}

    @property
    def info(self) -> ModulatorInfo:
        """Identity and reach, as the controller tells them."""
        return self._connected().info

    @property
    def modulation(self) -> Modulation | None:
        """The modulation in force; the controller is asked whether it still turns."""
        if self._connection is None:
            return None
        # Nobody knows what a stage does that has been lost.
        self._connection.controller.link.require_alive()
        if self._now is None:
            return None
        with self._understood():
            if all(self._connection.controller.running()):
                return self._now
        log.warning("%s: no longer turns; somebody or something else stopped it", self.name)
        self._now = None
        return None

    # ------------------------------------------------------------------ opening and closing
    def _open(self) -> None:
        with self._meeting() as here:
            try:
                start_up(self.name, here.controller, self._section.stage, here.travel, self._sleep)
            except BaseException as failure:
                self._tidy(lambda: self._give_up(here.controller), failure)
                raise
        self._connection = here

    @contextmanager
    def _meeting(self) -> Iterator[_Connection]:
        """Connect and learn what is there; moves nothing. Hangs up again when that, or the body, fails."""
        link = Link(self.name, self._connect(), self._section.wire.timeout_s)
        try:
            link.open()
            controller = E727(link, self._section.stage.axes)
            with self._understood():
                travel = learn_travel(self.name, controller, self._section)
                model = f"PI {controller.model} with {controller.stages()[0]}"
                turning = Turning(
                    self.name, controller, self._section.stage, travel, self._responses, self._sleep
                )
                reach = min(travel.reach_rad, self._section.max_tilt_rad)
                info = ModulatorInfo(model, controller.serial, reach, "emulated" in link.identity)
                yield _Connection(controller, travel, turning, info)
        except BaseException:
            link.close()
            raise

    def _close(self) -> None:
        here, self._connection, self._now = self._connection, None, None
        if here is None:
            return
        try:
            self._switch_off(here.controller)
        finally:
            here.controller.link.close()

    def _give_up(self, controller: E727) -> None:
        """Stop whatever a start-up had begun, then switch off."""
        if controller.link.alive:
            controller.halt()
        self._switch_off(controller)

    def _switch_off(self, controller: E727) -> None:
        """Servos off and no volts, unless the link has been lost before, which was told then."""
        if controller.link.alive:
            shut_down(controller)

    # ------------------------------------------------------------------ the hooks
    def _check(self, want: Modulation) -> Modulation:
        return self._connected().turning.achievable(want)

    def _modulate(self, modulation: Modulation) -> None:
        here = self._connected()
        self._now = None
        try:
            with self._understood():
                here.turning.turn(modulation)
        except DeviceLost as lost:
            lost.add_note(_GOES_ON)
            raise
        except DeviceError as failure:
            # A circle that is not the one asked for is worse than none.
            self._tidy(self._park, failure)
            raise
        self._now = modulation

    def _park(self) -> None:
        here = self._connected()
        self._now = None
        try:
            with self._understood():
                here.turning.stop()
                here.controller.go(here.travel.centre, self._section.stage.settle_s, self._sleep)
        except DeviceLost as lost:
            lost.add_note(_GOES_ON)
            raise

    def _status(self) -> ModulatorStatus:
        with self._understood():
            return self._status_of(self._connected())

    def _look(self) -> ModulatorStatus:
        with self._meeting() as here:
            status = self._status_of(here)
        here.controller.link.close()
        return status

    def _status_of(self, here: _Connection) -> ModulatorStatus:
        controller, travel = here.controller, here.travel
        tilt = travel.tilts(np.array(controller.places()))
        modulation = self.modulation or here.turning.found_turning()
        details: dict[str, Any] = {
            "identity": controller.link.identity,
            "servo": controller.servos(),
            "auto_zeroed": controller.zeroed(),
            "travel": {
                "lower": travel.lower.tolist(),
                "upper": travel.upper.tolist(),
                "unit_rad": travel.unit_rad,
            },
            "recoveries": controller.link.recoveries,
            "circle_error": here.turning.error if self._now else None,
            "corrections": here.turning.corrections(),
        }
        return ModulatorStatus(here.info, modulation, (float(tilt[0]), float(tilt[1])), details)

    def _release(self) -> bool:
        if self._section.wire.kind == "emulator":
            # It ends with the connection.
            return False
        here, self._connection, self._now = self._connected(), None, None
        here.controller.link.close()
        return True

    # ------------------------------------------------------------------ tools
    def _connected(self) -> _Connection:
        if self._connection is None:
            self.require_open()
            raise DeviceLost(self.name, "not connected; close it and open it again")
        return self._connection

    @contextmanager
    def _understood(self) -> Iterator[None]:
        """What the codec could not make sense of becomes this device's error."""
        try:
            yield
        except Garbled as error:
            raise DeviceError(
                self.name, f"said something unexpected: {error}; see the bench checklist"
            ) from error
