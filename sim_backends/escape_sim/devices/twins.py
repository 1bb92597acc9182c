"""Simulated devices of a bench: mirrors, cameras, phase screens, modulator; their entry points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
from escape_hw.api.flips import Flip, flip_image, inverse_flip
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.api.modulator import Modulation, ModulatorInfo, TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
from escape_hw.config.sensor import PyramidSection
from escape_hw.errors import ConfigError, FrameTimeout, SettingRejected
from escape_sim.devices.bench import SimBench
from escape_sim.mirror.shell import AMBIENT_C, RISE_C_PER_A, TRANSITION_S, Shell
from escape_sim.optics.detector import Detector
from escape_sim.optics.focal_plane import FocalPlane

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.registry import DeviceContext
    from escape_hw.config.system import SystemConfig

_BENCH_KEY = "simulated bench"
#: Resolution of the cameras' exposure times in seconds.
_EXPOSURE_STEP_S = 1e-6
Info = TypeVar("Info")
Device = TypeVar("Device")


def shared_bench(config: SystemConfig, shared: dict[str, object]) -> SimBench:
    """The simulated bench shared by all simulated devices of an opened system."""
    bench = shared.setdefault(_BENCH_KEY, None) or SimBench(config)
    if not isinstance(bench, SimBench):
        raise TypeError(f"shared[{_BENCH_KEY!r}] holds a {type(bench).__name__}, not a SimBench")
    shared[_BENCH_KEY] = bench
    return bench


def existing_bench(shared: dict[str, object]) -> SimBench | None:
    """The simulated bench of an opened system, or None if no simulated device was made yet."""
    bench = shared.get(_BENCH_KEY)
    return bench if isinstance(bench, SimBench) else None


class _Simulated(Generic[Info]):
    """Identity, clock and connection of a simulated device, a mix-in placed before its interface."""

    _bench: SimBench
    _info: Info

    @property
    def info(self) -> Info:
        """Identity and fixed properties."""
        return self._info

    @property
    def twin(self) -> SimBench:
        """The simulated bench with its true state; for tests and benchmarks only."""
        return self._bench

    @property
    def applies_twin_section(self) -> bool:
        """True: the simulated bench has the state that ``[twin]`` describes."""
        return True

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """Nothing to release; the device keeps its state."""


class SimMirror(_Simulated[DMInfo], DeformableMirror):
    """Simulated deformable mirror: latency, settling, creep, gain scatter, saturation."""

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name, bench.config.devices.dm.limits.to_limits())
        self._bench = bench
        dm = bench.config.devices.dm
        self._info = dm.info(f"simulated mirror of {dm.n_act} actuators", simulated=True)

    def _open(self) -> None:
        self._bench.set_positions(np.zeros(self._info.n_act))

    def _send(self, command: NDArray[np.float64]) -> None:
        self._bench.drive(command)


class _SimCamera(_Simulated[CameraInfo], Camera):
    """Settings, limits and frame times common to both simulated cameras."""

    def __init__(self, name: str, bench: SimBench, section: CameraConfig, model: str) -> None:
        super().__init__(name)
        self._bench, self._settings = bench, section.settings()
        self._info = CameraInfo(model, section.serial, section.sensor_px[::-1], section.bit_depth, True)
        self._start_s, self._next_index = 0.0, 0

    @property
    def settings(self) -> CameraSettings:
        """Settings in force."""
        return self._settings

    def _start(self) -> None:
        self._start_s, self._next_index = self._bench.now_s, 0

    def _stop(self) -> None:
        """Nothing to stop."""

    def _fastest_hz(self, region: Region) -> float:
        """Highest frame rate for a region: readout time per row."""
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
        step = _EXPOSURE_STEP_S
        exposure = min(max(round(want.exposure_s / step) * step, step), 1 / want.frame_rate_hz)
        return CameraSettings(want.region, exposure, want.frame_rate_hz, want.gain_db)

    def _configure(self, settings: CameraSettings) -> None:
        self._settings = settings

    def _next_frame_index(self, arrival_delay_s: float) -> int:
        """Index of the next frame to deliver: for a late reader the newest complete one."""
        period = 1 / self.settings.frame_rate_hz
        n_complete = int((self._bench.now_s - self._start_s - arrival_delay_s) / period + 1e-9)
        return max(self._next_index, n_complete)

    def _advance_to_arrival(self, arrival_s: float, timeout_s: float) -> None:
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
    """Simulated camera behind lenslets or pyramid: rate limits, noise, lost frames.

    While a modulator runs, it triggers the camera once per cycle or once per several cycles, whichever
    is nearest to the configured rate; an exposure lasts whole cycles.
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        section = bench.config.devices.wfs
        super().__init__(name, bench, section, "simulated wavefront-sensor camera")
        self._nominal = Region(*section.region)
        self._period, self._first = 0.0, 0

    @property
    def settings(self) -> CameraSettings:
        """Settings in force, with the modulator's trigger."""
        return self._with_trigger_period(self._settings)

    def _with_trigger_period(self, settings: CameraSettings) -> CameraSettings:
        """Settings as changed by the modulator's trigger."""
        cycle_s = self._bench.beam_path.cycle_period_s
        if cycle_s is None:
            return settings
        frame = max(1, round(1 / (settings.frame_rate_hz * cycle_s))) * cycle_s
        return replace(settings, exposure_s=frame, frame_rate_hz=1 / frame)

    def _check(self, want: CameraSettings) -> CameraSettings:
        if want.region != self._nominal and (
            want.region.x < self._nominal.x
            or want.region.y < self._nominal.y
            or want.region.x + want.region.width > self._nominal.x + self._nominal.width
            or want.region.y + want.region.height > self._nominal.y + self._nominal.height
        ):
            raise SettingRejected(
                self.name, f"region {want.region} is not inside the configured region {self._nominal}"
            )
        return self._with_trigger_period(super()._check(want))

    def _start(self) -> None:
        super()._start()
        self._period, self._first = 1 / self.settings.frame_rate_hz, 0

    def _update_trigger_period(self) -> None:
        """Restart the frame times if the modulator has started, stopped or changed its frequency."""
        period = 1 / self.settings.frame_rate_hz
        if period != self._period:
            self._first, self._period = self._first + self._next_index, period
            self._start_s, self._next_index = self._bench.now_s, 0

    def _next_frame(self, timeout_s: float) -> Frame:
        self._update_trigger_period()
        bench, s, twin = self._bench, self.settings, self._bench.config.twin
        period = self._period
        deadline = bench.now_s + timeout_s
        while True:
            k = self._next_frame_index(s.exposure_s + twin.readout_s)
            start = self._start_s + k * period
            end = start + s.exposure_s
            self._advance_to_arrival(end + twin.readout_s, max(deadline - bench.now_s, 0.0))
            self._next_index = k + 1
            if not twin.loss_probability or bench.frame_rng.random() >= twin.loss_probability:
                break
        image, opd = bench.wfs_image(start, end)
        bench.record_optical_path(opd, end)
        gain = 10 ** (s.gain_db / 20)
        source, sky = bench.wfs_light(s.exposure_s)
        data, saturated = bench.wfs_detector.expose(image, source * gain, sky * gain)
        data = _as_mounted(data, twin.wfs.flip)
        r, n = s.region, self._nominal
        data = data[r.y - n.y : r.y - n.y + r.height, r.x - n.x : r.x - n.x + r.width]
        data.flags.writeable = False
        return Frame(data, self._first + k, round(end * 1e9), bench.now_ns, saturated)


class SimScienceCamera(_SimCamera):
    """Simulated science camera, which integrates the focal plane while the loop runs."""

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name, bench, bench.science_section, "simulated science camera")
        self._plane: FocalPlane | None = None
        self._detector: Detector | None = None

    def _start(self) -> None:
        super()._start()
        shape = (self._settings.region.height, self._settings.region.width)
        if self._plane is None or self._detector is None or self._detector.shape != shape:
            self._plane, self._detector = self._bench.focal_plane(shape), self._bench.science_detector(shape)
        s = self._settings
        self._bench.start_integration(self._plane, s.exposure_s, 1 / s.frame_rate_hz)

    def _stop(self) -> None:
        self._bench.stop_integration()

    def _next_frame(self, timeout_s: float) -> Frame:
        bench, s = self._bench, self._settings
        k = self._next_frame_index(s.exposure_s)
        end = self._start_s + k / s.frame_rate_hz + s.exposure_s
        self._advance_to_arrival(end, timeout_s)
        self._next_index = k + 1
        image = bench.mean_image(k, end)
        if self._detector is None:
            raise RuntimeError("the science camera is not running")
        scale = s.exposure_s / bench.science_section.exposure_s
        electrons = 0.0 if bench.beam_blocked else bench.config.twin.science.photons_per_frame * scale
        data, saturated = self._detector.expose(image, electrons)
        data = _as_mounted(data, bench.config.twin.science.flip)
        data.flags.writeable = False
        return Frame(data, k, round(end * 1e9), bench.now_ns, saturated)


def _as_mounted(image: NDArray[np.uint16], flip: Flip) -> NDArray[np.uint16]:
    """The image of a camera whose images must be turned by ``flip``."""
    return np.ascontiguousarray(flip_image(image, inverse_flip(flip)))


class SimPhaseScreen(_Simulated[ScreenInfo], PhaseScreen):
    """Simulated changer with rotating phase screens."""

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name)
        screen = bench.config.devices.screen
        self._bench, self._n_screens = bench, len(screen.screens_r0_m) if screen else 0
        self._info = ScreenInfo("simulated phase screens", screen.serial if screen else "", simulated=True)

    @property
    def state(self) -> ScreenState:
        """Present state."""
        b = self._bench
        return ScreenState(b.plates.number, b.plates.inserted, b.plates.speed_m_s, b.beam_blocked)

    @property
    def n_screens(self) -> int:
        """Number of screens in the changer."""
        return self._n_screens

    def _set(self, want: ScreenState) -> None:
        b = self._bench
        b.plates.number, b.plates.inserted, b.beam_blocked = want.screen, want.inserted, want.blocked
        b.plates.set_speed(want.speed_m_s, b.now_s)


#: Servo period of the controller in seconds; a modulation cycle is a whole number of them.
SERVO_S = 50e-6
#: Fewest and most servo periods of a cycle: limits of a loaded stage and of the wave tables.
_CYCLE_STEPS = (20, 262_144)


class SimModulator(_Simulated[ModulatorInfo], TipTiltModulator):
    """Simulated PI S-330 with E-727: the frequency is rounded to the servo clock, starting takes time.

    It reports the commanded modulation. Ellipticity, phase lag and centre drift (``twin.pyramid``) affect
    only the beam.
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name)
        section = bench.config.devices.modulator
        if section is None:
            raise ConfigError(f"system {bench.config.system.name!r} has no [devices.modulator] section")
        bench.config.sensor_as(PyramidSection)
        self._bench = bench
        self._info = ModulatorInfo(
            "simulated PI S-330 with E-727", section.serial, section.max_tilt_rad, True
        )

    @property
    def modulation(self) -> Modulation | None:
        """Modulation in force."""
        return self._bench.beam_path.modulation

    def _check(self, want: Modulation) -> Modulation:
        steps = round(1 / (want.frequency_hz * SERVO_S))
        fewest, most = _CYCLE_STEPS
        if not fewest <= steps <= most:
            raise SettingRejected(
                self.name,
                f"frequency_hz is {want.frequency_hz:g}; it must lie in {1 / (most * SERVO_S):.2g}.."
                f"{1 / (fewest * SERVO_S):g} Hz",
            )
        return replace(want, frequency_hz=1 / (steps * SERVO_S))

    def _modulate(self, modulation: Modulation) -> None:
        bench = self._bench
        bench.advance_to(bench.now_s + bench.config.twin.pyramid.start_s)
        bench.beam_path.modulation = modulation

    def _park(self) -> None:
        self._bench.beam_path.modulation = None


class SimAdaptiveSecondary(_Simulated[DMInfo], AdaptiveSecondary):
    """Simulated 336-actuator secondary of the MMT: mirror dynamics, latency, and a floating shell.

    ``lift`` in the options of its device section (default true): opening it leads to ``RUNNING``.
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        dm = bench.config.devices.dm
        super().__init__(name, dm.limits.to_limits(), lift=bool(dm.options.get("lift", True)))
        self._bench = bench
        self._info = dm.info("simulated MMT adaptive secondary", simulated=True)
        noise = np.random.SeedSequence(bench.config.system.seed, spawn_key=(0xA5,))
        self._shell = Shell(bench, dm.n_act, dm.stroke_m, np.random.default_rng(noise))

    def trip(self, reason: str) -> None:
        """Simulate a latched fault: coils off, the shell on its reference body."""
        self._shell.trip(reason)

    def _send_to_shell(self, command: NDArray[np.float64]) -> None:
        self._bench.drive(command)

    def _state(self) -> ShellState:
        return self._shell.state

    def _step(self, state: ShellState) -> None:
        self._bench.advance_to(self._bench.now_s + TRANSITION_S[state])
        self._shell.finish_transition(state, self._to_hardware(self.flat))

    def _recover(self) -> None:
        self._shell.recover()

    def _measure_positions(self) -> NDArray[np.float64]:
        return self._shell.measure_positions()

    def _observe_health(self) -> ShellHealth:
        return self._health()

    def _health(self) -> ShellHealth:
        shell = self._shell
        current = float(shell.currents_a().max())
        return ShellHealth(
            self._bench.now_ns, shell.state, shell.gap_m(), current, AMBIENT_C + RISE_C_PER_A * current, 0,
            shell.fault,
        )  # fmt: skip


def _factory(device: Callable[[str, SimBench], Device]) -> Callable[[object, DeviceContext], Device]:
    """Entry point that creates a device on the shared bench of a system."""
    return lambda section, context: device(
        context.name, shared_bench(context.require_system(), context.shared)
    )


make_mirror = _factory(SimMirror)
make_wfs_camera = _factory(SimWavefrontSensorCamera)
make_science_camera = _factory(SimScienceCamera)
make_screen = _factory(SimPhaseScreen)
make_modulator = _factory(SimModulator)
make_secondary = _factory(SimAdaptiveSecondary)
