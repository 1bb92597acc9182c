"""Minimal devices that satisfy every contract, for tests of procedures and as examples of drivers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.modulator import Modulation, ModulatorInfo, TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
from escape_hw.errors import FrameTimeout, SettingRejected
from escape_hw.safety.limits import MirrorLimits


class _NothingToConnect(Device):
    """Connection of a device without hardware, a mix-in placed before its interface."""

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass


class RecordingMirror(_NothingToConnect, DeformableMirror):
    """A mirror of 21 actuators in a circle (5 x 5 without corners) that records its commands.

    Attributes
    ----------
    history
        Every command that reached the device, in order, over all openings.
    """

    def __init__(self, name: str = "mirror", limits: MirrorLimits | None = None) -> None:
        super().__init__(name, limits or MirrorLimits())
        self.history: list[NDArray[np.float64]] = []

    @property
    def info(self) -> DMInfo:
        """Identity and geometry; pitch 1.5 mm, 2 micrometres of stroke."""
        axis = np.arange(5) - 2
        layout = axis[:, None] ** 2 + axis**2 <= 5
        rows, columns = np.nonzero(layout)
        positions_m = np.stack([axis[columns], axis[rows]], axis=1) * np.float64(1.5e-3)
        return DMInfo("recording", "REF-DM", int(layout.sum()), layout, positions_m, 2e-6, simulated=True)

    def _send(self, command: NDArray[np.float64]) -> None:
        self.history.append(command.copy())


class IdealSecondary(_NothingToConnect, AdaptiveSecondary):
    """An adaptive secondary of 21 actuators that reaches every state and shape at once."""

    def __init__(self, name: str = "secondary", limits: MirrorLimits | None = None) -> None:
        super().__init__(name, limits or MirrorLimits())
        self._current_state = ShellState.OFF
        self._last = np.zeros(self.info.n_act)

    @property
    def info(self) -> DMInfo:
        """Identity and geometry of :class:`RecordingMirror`."""
        return RecordingMirror().info

    def _send_to_shell(self, command: NDArray[np.float64]) -> None:
        self._last = command

    def _state(self) -> ShellState:
        return self._current_state

    def _step(self, state: ShellState) -> None:
        self._current_state, self._last = state, self._to_hardware(self.flat)

    def _recover(self) -> None:
        self._current_state = ShellState.RESTED

    def _measure_positions(self) -> NDArray[np.float64]:
        return self._last

    def _health(self) -> ShellHealth:
        return ShellHealth(self.now_ns(), self._current_state, 50e-6, 0.1, 15.0, 0)


class SyntheticCamera(_NothingToConnect, Camera):
    """A camera of 64 x 48 pixels on a simulated clock with a resolution of 1 us."""

    _TICK_NS = 1000
    _STEP_PX = 4

    def __init__(self, name: str = "camera") -> None:
        super().__init__(name)
        self._settings = CameraSettings(Region(8, 4, 32, 24), 1e-3, 500.0)
        self._clock_ns = self._exposed_ns = self._index = 0

    @property
    def info(self) -> CameraInfo:
        """Identity; 10 bits."""
        return CameraInfo("synthetic", "REF-CAM", (48, 64), 10, simulated=True)

    @property
    def settings(self) -> CameraSettings:
        """The settings in force."""
        return self._settings

    def now_ns(self) -> int:
        """The simulated clock; it advances with frames and time-outs only."""
        return self._clock_ns

    @property
    def _period_ns(self) -> int:
        return round(1e9 / self._settings.frame_rate_hz / self._TICK_NS) * self._TICK_NS

    def _check(self, want: CameraSettings) -> CameraSettings:
        if not 1 <= want.frame_rate_hz <= 2000:
            raise SettingRejected(
                self.name, f"frame_rate_hz is {want.frame_rate_hz}; the range is 1 to 2000 Hz"
            )
        period_us = round(1e6 / want.frame_rate_hz)
        exposure_us = min(max(1, round(want.exposure_s * 1e6)), period_us)
        region, step = want.region, self._STEP_PX
        width, height = (side // step * step for side in (region.width, region.height))
        if min(width, height) < step:
            raise SettingRejected(self.name, f"{region} contains no {step} x {step} pixels; enlarge it")
        whole = Region(region.x, region.y, width, height)
        return CameraSettings(whole, exposure_us * 1e-6, 1e6 / period_us, round(want.gain_db, 1))

    def _configure(self, settings: CameraSettings) -> None:
        self._settings = replace(settings)

    def _start(self) -> None:
        self._exposed_ns = self._clock_ns

    def _stop(self) -> None:
        """Frames are created on request."""

    def _next_frame(self, timeout_s: float) -> Frame:
        due_ns, deadline_ns = self._exposed_ns + self._period_ns, self._clock_ns + round(timeout_s * 1e9)
        if due_ns > deadline_ns:
            self._clock_ns = deadline_ns
            raise FrameTimeout(self.name, f"no frame within {timeout_s:g} s")
        self._exposed_ns = self._clock_ns = due_ns
        self._index += 1
        region = self._settings.region
        ramp = np.arange(region.height * region.width) + self._index
        data = (ramp % (self.info.full_scale + 1)).astype(np.uint16).reshape(region.height, region.width)
        data.setflags(write=False)
        n_saturated = int(np.count_nonzero(data == self.info.full_scale))
        return Frame(data, self._index, due_ns, due_ns, n_saturated)


class QuantisedModulator(_NothingToConnect, TipTiltModulator):
    """A stage whose period is a whole number of steps of 50 microseconds."""

    STEP_S = 50e-6

    def __init__(self, name: str = "modulator") -> None:
        super().__init__(name)
        self._modulation: Modulation | None = None

    @property
    def info(self) -> ModulatorInfo:
        """Identity; a milliradian of tilt."""
        return ModulatorInfo("quantised", "REF-MOD", 1e-3, simulated=True)

    @property
    def modulation(self) -> Modulation | None:
        """The modulation in force."""
        return self._modulation

    def _check(self, want: Modulation) -> Modulation:
        steps = round(1 / (want.frequency_hz * self.STEP_S))
        if not 4 <= steps <= 100_000:
            raise SettingRejected(
                self.name, f"frequency_hz is {want.frequency_hz}; the range is 0.2 to 5000 Hz"
            )
        return replace(want, frequency_hz=1 / (steps * self.STEP_S))

    def _modulate(self, modulation: Modulation) -> None:
        self._modulation = modulation

    def _park(self) -> None:
        self._modulation = None


class IdealPhaseScreen(_NothingToConnect, PhaseScreen):
    """A changer with four screens that reaches every state at once."""

    def __init__(self, name: str = "screen") -> None:
        super().__init__(name)
        self._state = ScreenState(1, inserted=True, speed_m_s=0.0135)

    @property
    def info(self) -> ScreenInfo:
        """Identity."""
        return ScreenInfo("steady", "REF-SCREEN", simulated=True)

    @property
    def state(self) -> ScreenState:
        """The present state."""
        return self._state

    @property
    def n_screens(self) -> int:
        """Four."""
        return 4

    def _set(self, want: ScreenState) -> None:
        self._state = want
