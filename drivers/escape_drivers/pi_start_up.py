"""The order in which a PI tip-tilt stage is switched on and off."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from escape_drivers.pi_controller import E727
from escape_drivers.pi_travel import Travel
from escape_hw.errors import DeviceError

if TYPE_CHECKING:
    from escape_hw.config.modulator_models import StageConfig

log = logging.getLogger(__name__)

#: How often auto-zero is asked whether it has ended, in seconds.
_POLL_S = 0.05


def start_up(
    name: str, controller: E727, stage: StageConfig, travel: Travel, sleep: Callable[[float], None]
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
    zero = stage.auto_zero == "always" or (stage.auto_zero == "needed" and not all(controller.zeroed()))
    if zero or not all(controller.servos()):
        controller.set_servo(False)
        if not zero and not all(controller.zeroed()):
            log.warning("%s: servos on without auto-zero, as configured: places may be off", name)
        if zero:
            _auto_zero(name, controller, stage, sleep)
        controller.set_volts(0.0)
        controller.set_servo(True)
    controller.go(travel.centre, stage.settle_s, sleep)


def shut_down(controller: E727) -> None:
    """Servos off, no volts; the stage has been stopped and centred before."""
    controller.set_servo(False)
    controller.set_volts(0.0)


def _auto_zero(name: str, controller: E727, stage: StageConfig, sleep: Callable[[float], None]) -> None:
    """One axis after the other, each until it is done."""
    for number, axis in enumerate(stage.axes):
        log.warning("%s: auto-zero of axis %s sweeps its full range", name, axis)
        controller.start_auto_zero(axis, stage.auto_zero_v)
        deadline = time.monotonic() + stage.auto_zero_s
        while not controller.zeroed()[number]:
            # A failure shows in the pending error only, which the next command would trip over.
            controller.check_error(f"ATZ {axis}")
            if time.monotonic() > deadline:
                raise DeviceError(
                    name,
                    f"auto-zero of axis {axis} has not ended after {stage.auto_zero_s:g} s; is the "
                    "platform free to move, its cable plugged in? The longest wait is "
                    "devices.modulator.stage.auto_zero_s",
                )
            sleep(_POLL_S)
