"""Twins of the devices; each obeys the same contract as the real one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera
from escape_hw.api.frames import CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.screen import PhaseScreen, ScreenInfo, ScreenState
from escape_hw.errors import ConfigError, FrameTimeout, SettingRejected
from escape_sim.detector import Detector
from escape_sim.psf import FocalPlane
from escape_sim.sim_bench import SimBench

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

_SHARED = "simulated bench"


def shared_bench(config: SystemConfig, shared: dict[str, object]) -> SimBench:
    """The one simulated bench behind all twins of an opened system."""
    bench = shared.setdefault(_SHARED, None) or SimBench(config)
    if not isinstance(bench, SimBench):
        raise TypeError(f"shared[{_SHARED!r}] holds a {type(bench).__name__}, not a SimBench")
    shared[_SHARED] = bench
    return bench


def present_bench(shared: dict[str, object]) -> SimBench | None:
    """The simulated bench of an opened system, if any of its devices is a twin that has been made."""
    bench = shared.get(_SHARED)
    return bench if isinstance(bench, SimBench) else None


def make_mirror(name: str, config: SystemConfig, shared: dict[str, object]) -> SimMirror:
    """Entry point ``sim-alpao``."""
    return SimMirror(name, shared_bench(config, shared))


def make_wfs_camera(name: str, config: SystemConfig, shared: dict[str, object]) -> SimWavefrontSensorCamera:
    """Entry point ``sim-ximea``."""
    return SimWavefrontSensorCamera(name, shared_bench(config, shared))


def make_science_camera(name: str, config: SystemConfig, shared: dict[str, object]) -> SimScienceCamera:
    """Entry point ``sim-science``."""
    return SimScienceCamera(name, shared_bench(config, shared))


def make_screen(name: str, config: SystemConfig, shared: dict[str, object]) -> SimPhaseScreen:
    """Entry point ``sim-screen``."""
    return SimPhaseScreen(name, shared_bench(config, shared))


class SimMirror(DeformableMirror):
    """Twin of the ALPAO DM97: latency, settling, creep, gain scatter, saturation."""

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name, bench.config.devices.dm.limits.to_limits())
        self._bench = bench
        self._info = bench.config.devices.dm.info("simulated ALPAO DM97-15", simulated=True)

    @property
    def info(self) -> DMInfo:
        """Identity and geometry."""
        return self._info

    @property
    def twin(self) -> SimBench:
        """The simulated bench, hidden truth and all; for tests and benchmarks alone."""
        return self._bench

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def _open(self) -> None:
        self._bench.place(np.zeros(self._info.n_act))

    def _close(self) -> None:
        """Nothing to release."""

    def _send(self, command: NDArray[np.float64]) -> None:
        self._bench.drive(command)


class _SimCamera(Camera):
    """What both simulated cameras share: settings and limits of the sensor."""

    def __init__(
        self, name: str, bench: SimBench, info: CameraInfo, settings: CameraSettings, step_s: float
    ) -> None:
        super().__init__(name)
        self._bench, self._info, self._settings, self._step_s = bench, info, settings, step_s
        self._start_s, self._next = 0.0, 0

    @property
    def info(self) -> CameraInfo:
        """Identity and fixed properties."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """The settings in force."""
        return self._settings

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """Nothing to release."""

    def _start(self) -> None:
        self._start_s, self._next = self._bench.now_s, 0

    def _stop(self) -> None:
        """The clock simply runs on."""

    def _fastest_hz(self, region: Region) -> float:
        """Highest frame rate for a region; rows cost time, columns do not."""
        return 1.0 / (20e-6 + 4.65e-6 * region.height)

    def _check(self, want: CameraSettings) -> CameraSettings:
        fastest = self._fastest_hz(want.region)
        if want.frame_rate_hz > fastest * 1.0001:
            raise SettingRejected(
                self.name,
                f"frame_rate_hz is {want.frame_rate_hz:g}; "
                f"{want.region.height} rows allow at most {fastest:.1f}",
            )
        if not 0 <= want.gain_db <= 12:
            raise SettingRejected(self.name, f"gain_db is {want.gain_db:g}; it must lie in 0..12")
        longest = 1 / want.frame_rate_hz
        exposure = min(max(round(want.exposure_s / self._step_s) * self._step_s, self._step_s), longest)
        return CameraSettings(want.region, exposure, want.frame_rate_hz, want.gain_db)

    def _configure(self, settings: CameraSettings) -> None:
        self._settings = settings

    def _newest(self, arrival_delay_s: float) -> int:
        """Number of the frame to deliver next: a late reader gets the newest complete one."""
        period = 1 / self.settings.frame_rate_hz
        complete = int((self._bench.now_s - self._start_s - arrival_delay_s) / period + 1e-9)
        return max(self._next, complete)

    def _wait_until(self, arrival_s: float, timeout_s: float) -> None:
        bench = self._bench
        if arrival_s > bench.now_s + timeout_s:
            bench.advance_to(bench.now_s + timeout_s)
            raise FrameTimeout(
                self.name,
                f"no frame within {timeout_s:g} s; check trigger, exposure ({self.settings.exposure_s:g} s) "
                "and cable, or allow a longer timeout",
            )
        bench.advance_to(arrival_s)


class SimWavefrontSensorCamera(_SimCamera):
    """Twin of the XIMEA camera behind lenslets or pyramid: rate limits, noise, lost frames.

    A modulator triggers it once per turn, or once in so many turns as its own rate comes nearest to;
    then it exposes whole turns.
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        c = bench.config.devices.wfs
        super().__init__(
            name,
            bench,
            CameraInfo("simulated XIMEA MQ013MG-ON", c.serial, c.sensor_px[::-1], c.bit_depth, True),
            c.settings(),
            1e-6,
        )
        self._nominal = Region(*c.region)
        self._period, self._first = 0.0, 0

    @property
    def settings(self) -> CameraSettings:
        """The settings in force."""
        return self._followed(self._settings)

    def _followed(self, settings: CameraSettings) -> CameraSettings:
        """The settings as the modulator's trigger changes them."""
        turn = self._bench.beam_circle.turn_s
        if turn is None:
            return settings
        frame = max(1, round(1 / (settings.frame_rate_hz * turn))) * turn
        return replace(settings, exposure_s=frame, frame_rate_hz=1 / frame)

    def _check(self, want: CameraSettings) -> CameraSettings:
        if want.region != self._nominal and (
            want.region.x < self._nominal.x
            or want.region.y < self._nominal.y
            or want.region.x + want.region.width > self._nominal.x + self._nominal.width
            or want.region.y + want.region.height > self._nominal.y + self._nominal.height
        ):
            raise SettingRejected(
                self.name, f"region {want.region} leaves the lit part of the sensor, {self._nominal}"
            )
        return self._followed(super()._check(want))

    def _start(self) -> None:
        super()._start()
        self._period, self._first = 1 / self.settings.frame_rate_hz, 0

    def _follow(self) -> None:
        """Count on from here when the modulator has started, stopped or changed its pace."""
        period = 1 / self.settings.frame_rate_hz
        if period != self._period:
            self._first, self._period = self._first + self._next, period
            self._start_s, self._next = self._bench.now_s, 0

    def _next_frame(self, timeout_s: float) -> Frame:
        self._follow()
        bench, s, twin = self._bench, self.settings, self._bench.config.twin
        period = self._period
        deadline = bench.now_s + timeout_s
        while True:
            k = self._newest(s.exposure_s + twin.readout_s)
            start = self._start_s + k * period
            end = start + s.exposure_s
            self._wait_until(end + twin.readout_s, max(deadline - bench.now_s, 0.0))
            self._next = k + 1
            if not twin.loss_probability or bench.frame_rng.random() >= twin.loss_probability:
                break
        image, opd = bench.wfs_image(start, end)
        bench.observe(opd, end)
        gain = 10 ** (s.gain_db / 20)
        source, sky = bench.wfs_light(s.exposure_s)
        data, saturated = bench.wfs_detector.expose(image, source * gain, sky * gain)
        r, n = s.region, self._nominal
        data = data[r.y - n.y : r.y - n.y + r.height, r.x - n.x : r.x - n.x + r.width]
        data.flags.writeable = False
        return Frame(data, self._first + k, round(end * 1e9), bench.now_ns, saturated)


class SimScienceCamera(_SimCamera):
    """Twin of the science camera: integrates the focal plane beside the running loop."""

    def __init__(self, name: str, bench: SimBench) -> None:
        c = bench.config.devices.science
        if c is None:
            raise ConfigError(f"system {bench.config.system.name!r} has no [devices.science] section")
        super().__init__(
            name,
            bench,
            CameraInfo("simulated FLIR Grasshopper3", c.serial, c.sensor_px[::-1], c.bit_depth, True),
            c.settings(),
            1e-6,
        )
        self._plane: FocalPlane | None = None
        self._detector: Detector | None = None

    def _start(self) -> None:
        super()._start()
        shape = (self._settings.region.height, self._settings.region.width)
        if self._plane is None or self._detector is None or self._detector.shape != shape:
            self._plane, self._detector = self._bench.focal_plane(shape), self._bench.science_detector(shape)
        self._bench.watch(self._plane, self._settings.exposure_s, 1 / self._settings.frame_rate_hz)

    def _stop(self) -> None:
        self._bench.unwatch()

    def _next_frame(self, timeout_s: float) -> Frame:
        bench, s = self._bench, self._settings
        k = self._newest(s.exposure_s)
        end = self._start_s + k / s.frame_rate_hz + s.exposure_s
        self._wait_until(end, timeout_s)
        self._next = k + 1
        image = bench.integrated(k, end)
        if self._detector is None:
            raise RuntimeError("the science camera is not running")
        scale = s.exposure_s / (
            bench.config.devices.science.exposure_s if bench.config.devices.science else 1
        )
        electrons = 0.0 if bench.beam_blocked else bench.config.twin.science.photons_per_frame * scale
        data, saturated = self._detector.expose(image, electrons)
        data.flags.writeable = False
        return Frame(data, k, round(end * 1e9), bench.now_ns, saturated)


class SimPhaseScreen(PhaseScreen):
    """Twin of the changer with rotating phase screens."""

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name)
        self._bench = bench

    @property
    def info(self) -> ScreenInfo:
        """Identity."""
        screen = self._bench.config.devices.screen
        return ScreenInfo("simulated phase screens", screen.serial if screen else "", simulated=True)

    @property
    def state(self) -> ScreenState:
        """The present state."""
        b = self._bench
        return ScreenState(b.plates.number, b.plates.inserted, b.plates.speed_m_s, b.beam_blocked)

    @property
    def n_screens(self) -> int:
        """How many screens the changer holds."""
        screen = self._bench.config.devices.screen
        return len(screen.screens_r0_m) if screen else 0

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """The plate keeps turning."""

    def _set(self, want: ScreenState) -> None:
        b = self._bench
        b.plates.number, b.plates.inserted, b.beam_blocked = want.screen, want.inserted, want.blocked
        b.plates.set_speed(want.speed_m_s, b.now_s)
