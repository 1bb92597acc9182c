"""Tools for a single device: hold a shape, run a wave, record or monitor a camera."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera, Frame, FrameStatus
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.errors import CommandRejected

if TYPE_CHECKING:
    from escape_hw.config.devices import MirrorConfig

#: Commands per second of a wave, and seconds over which it rises.
WAVE_HZ, RISE_S = 100.0, 0.5
#: Phases of a period at which a wave is checked before it starts.
_CHECKED_PHASES = 16


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Commands sent, commands that the mirror skipped, and the largest value, fraction of full stroke.

    ``missed``: commands of a wave that could not be sent in its time.
    """

    commands: int
    skipped: int
    peak: float
    missed: int = 0


@dataclass(frozen=True, slots=True)
class CameraStatistics:
    """Statistics of a camera's frames: number, the camera's own counters, rate by the times of exposure.

    ``mean``, ``lowest`` and ``highest`` are counts over all pixels and frames; ``saturated`` is the number of
    saturated pixels in the worst frame.
    """

    frames: int
    status: FrameStatus
    rate_hz: float
    mean: float
    lowest: int
    highest: int
    saturated: int


class ConfiguredMirror(DeformableMirror):
    """The mirror that a configuration describes, without a device: checks shapes before one is opened."""

    def __init__(self, section: MirrorConfig) -> None:
        super().__init__("dm", section.limits.to_limits())
        self._info = section.info("configured", simulated=True)

    @property
    def info(self) -> DMInfo:
        """Identity and geometry, as configured."""
        return self._info

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass

    def _send(self, command: NDArray[np.float64]) -> None:
        pass


def poke_shape(dm: DeformableMirror, actuator: int, amplitude: float) -> NDArray[np.float64]:
    """The flat shape ``(n_act,)`` with one actuator moved.

    Raises
    ------
    CommandRejected
        The actuator does not exist, or the shape exceeds a limit; the message names the largest amplitude.
    """
    shape = dm.flat
    if actuator >= shape.size:
        raise CommandRejected(
            dm.name, f"actuator {actuator} does not exist; the mirror has 0 to {shape.size - 1}"
        )
    shape[actuator] += amplitude
    reached, report = dm.check(shape)
    if not report.is_unchanged:
        moved = reached[actuator] - dm.flat[actuator]
        slew = f"max_slew = {dm.limits.max_slew}" if report.slewed else None
        rules = ", ".join(filter(None, (dm.find_violation(shape), slew)))
        raise CommandRejected(
            dm.name,
            f"a poke of {amplitude:g} at actuator {actuator} is beyond its limits, which allow {moved:.4g} "
            f"with the other actuators flat ({rules}); choose that or less",
        )
    return shape


def hold_shape(dm: DeformableMirror, shape: NDArray[np.float64], seconds: float) -> Procedure[DriveResult]:
    """Hold a shape ``(n_act,)``, fractions of full stroke, for a while by the wall clock, then flatten."""
    report = Reporter("holding the shape", max(1, math.ceil(seconds)), "second")
    try:
        sent = dm.send(shape)
        started = time.monotonic()
        while (elapsed := time.monotonic() - started) < seconds:
            yield report(int(elapsed))
            time.sleep(min(Reporter.PERIOD_S, seconds - elapsed))
        return DriveResult(1, int(sent.skipped), float(np.abs(sent.sent).max()))
    finally:
        dm.flatten()


def wave_generator(
    dm: DeformableMirror, amplitude: float, waves: float
) -> Callable[[float], NDArray[np.float64]]:
    """A wave over the mirror along x: a function of the phase in turns that returns a shape ``(n_act,)``.

    Raises
    ------
    CommandRejected
        It exceeds a limit at some phase; the message names an amplitude that does not. Or the mirror's
        arrangement is not known.
    """
    x = dm.info.positions_m[:, 0]
    if not np.isfinite(x).all():
        raise CommandRejected(
            dm.name, f"a wave needs the arrangement of the {x.size} actuators; give it: --set layout=..."
        )
    along = waves * (x - x.min()) / max(float(np.ptp(x)), 1e-12)
    flat = dm.flat
    disabled = np.zeros(flat.size, dtype=bool)
    disabled[list(dm.limits.disabled)] = True

    def shape(turns: float) -> NDArray[np.float64]:
        wanted: NDArray[np.float64] = flat + amplitude * np.sin(2 * np.pi * (along - turns))
        wanted[disabled] = flat[disabled]
        return wanted

    fraction = min(dm.largest_legal_scale(shape(k / _CHECKED_PHASES)) for k in range(_CHECKED_PHASES))
    if fraction < 1:
        raise CommandRejected(
            dm.name, f"a wave of {amplitude:g} exceeds its limits; {fraction * amplitude:.3g} does not"
        )
    return shape


def run_wave(
    dm: DeformableMirror, shape: Callable[[float], NDArray[np.float64]], frequency_hz: float, seconds: float
) -> Procedure[DriveResult]:
    """Run a wave from :func:`wave_generator` over an open mirror, with a slow rise, then flatten.

    Each command advances the wave by the same time: a late command slows the wave down, and no shape is
    farther from the previous one than the frequency says. Commands that are late are not made up for.
    """
    report, total = Reporter("wave", max(1, math.ceil(seconds)), "second"), math.ceil(seconds * WAVE_HZ)
    commands = skipped = 0
    peak = 0.0
    flat = dm.flat
    try:
        # The first display of the progress takes longer than a command.
        yield report(0)
        due = started = time.monotonic()
        while commands < total and time.monotonic() - started < seconds:
            at = commands / WAVE_HZ
            sent = dm.send(flat + (shape(frequency_hz * at) - flat) * min(1.0, at / RISE_S))
            commands, skipped = commands + 1, skipped + sent.skipped
            peak = max(peak, float(np.abs(sent.sent).max()))
            if report.is_due():
                yield report(int(at), commands=commands)
            due = max(due + 1 / WAVE_HZ, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
        return DriveResult(commands, skipped, peak, total - commands)
    finally:
        dm.flatten()


def grab_frames(camera: Camera, frames: int, timeout_s: float, recorded: list[Frame]) -> Procedure[None]:
    """Record frames of an open camera; each may take ``timeout_s`` seconds.

    They are appended to ``recorded``, so that an abort or a failure of the camera does not lose them.
    """
    report = Reporter("grabbing", frames)
    for number in range(1, frames + 1):
        recorded.append(camera.next_frame(timeout_s))
        if report.is_due():
            yield report(number)
    camera.stop()


def monitor_camera(camera: Camera, seconds: float, timeout_s: float) -> Procedure[CameraStatistics]:
    """Statistics of an open camera over a duration by its own clock; each frame may take ``timeout_s``."""
    report = Reporter("watching", max(1, math.ceil(seconds)), "second")
    frames = saturated = highest = 0
    lowest, total, first_ns, last_ns = camera.info.full_scale, 0.0, 0, 0
    while frames < 2 or last_ns - first_ns < seconds * 1e9:
        frame = camera.next_frame(timeout_s)
        first_ns, last_ns, frames = first_ns or frame.exposed_ns, frame.exposed_ns, frames + 1
        total += float(frame.data.mean())
        lowest, highest = min(lowest, int(frame.data.min())), max(highest, int(frame.data.max()))
        saturated = max(saturated, frame.n_saturated)
        if report.is_due():
            yield report(int((last_ns - first_ns) * 1e-9), frames=frames, highest=highest)
    status = camera.status()
    camera.stop()
    rate = (frames - 1 + status.lost) / max((last_ns - first_ns) * 1e-9, 1e-9)
    return CameraStatistics(frames, status, rate, total / frames, lowest, highest, saturated)
