"""The simulated bench: one clock, one beam and the true state that no estimator reads."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.deprecation import renamed_members
from escape_hw.errors import ConfigError
from escape_sim.atmosphere.layers import Atmosphere, Seeing
from escape_sim.atmosphere.phase_plates import PhasePlates
from escape_sim.mirror.dynamics import MirrorDynamics
from escape_sim.mirror.influence_functions import (
    SINGLE_GAUSSIAN,
    InfluenceFunctions,
    actuator_positions,
    pitch_on_pupil,
)
from escape_sim.mirror.influence_maps import fill_gaps, read_cube
from escape_sim.mirror.measured import MeasuredInfluenceFunctions
from escape_sim.mirror.nominal import nominal_influence_functions
from escape_sim.mirror.rounded_exponential import draw_exponential
from escape_sim.mirror.surface import DriftingSurface, Flexure, InfluenceModel
from escape_sim.mirror.thin_plate import thin_plate_surfaces
from escape_sim.optics.base import ModulatedOptics, SensorOptics
from escape_sim.optics.detector import Detector
from escape_sim.optics.focal_plane import FocalPlane
from escape_sim.optics.modulation import BeamPath
from escape_sim.optics.pupil import contaminated_pupil, true_diameter, true_pupil
from escape_sim.optics.sensor import make_sensor_optics

if TYPE_CHECKING:
    from escape_hw.config.devices import ScienceConfig
    from escape_hw.config.system import SystemConfig

#: Spawn key that separates the streams of a run from those of a bench with the same seed.
_RUN_KEY = 0x52554E
#: Width of the wings of influence functions relative to their core.
_WING_WIDTH = 2.0
#: Largest lag in seconds behind the wall clock that a paced bench catches up.
_MAX_LAG_S = 0.05


@renamed_members(place="set_positions")
class SimBench:
    """Optics, mirror and clock shared by the simulated devices of a system.

    Parameters
    ----------
    config
        The system; its ``twin`` section is the true state.

    Attributes
    ----------
    flexure, seeing
        True registration and turbulence strength as functions of time; never for an estimator.
    path_callbacks
        Functions called with the optical path ``(n, n)`` in metres, and the time in seconds, of every
        frame of the wavefront sensor.
    """

    def __init__(self, config: SystemConfig) -> None:
        self.config = config
        seeds = np.random.SeedSequence(config.system.seed).spawn(8)
        plates, truth_seed, latency, frames, wfs_noise, science_noise, sky, contamination_seed = seeds
        self._run: np.random.SeedSequence | None = None
        if config.twin.run_seed is not None:
            # Pixel gains and offsets belong to the bench; the run's seed fixes what is drawn later.
            self._run = np.random.SeedSequence(config.twin.run_seed, spawn_key=(_RUN_KEY,))
            plates, latency, frames, sky = self._run.spawn(4)
        self.latency_rng, self.frame_rng = np.random.default_rng(latency), np.random.default_rng(frames)
        truth = np.random.default_rng(truth_seed)
        self.pupil = contaminated_pupil(config, np.random.default_rng(contamination_seed))
        clean_light = np.square(true_pupil(config).amplitude, dtype=float).sum()
        # Share of the light that the contaminated pupil transmits.
        self._throughput = float(np.square(self.pupil.amplitude, dtype=float).sum() / clean_light)
        self._clock_ns = 0
        self._wall_start = time.monotonic()
        dm, twin = config.devices.dm, config.twin
        self.influence = self._make_true_influence(truth)
        self.flexure = Flexure(twin.registration.to_registration(), twin.drift)
        self.seeing = Seeing(twin.seeing)
        x = self.pupil.coordinates_m
        self._surface = DriftingSurface(self.influence, self.flexure, self.pupil.sub_aperture_m, x, x)
        self.dynamics = MirrorDynamics(
            self.influence.n_act, twin.mirror.settling_s, twin.mirror.creep_fraction, twin.mirror.creep_time_s
        )
        # A reflection changes the path by twice the surface.
        self._order = dm.hardware_order(twin.mirror.order)
        self._opd_per_command_m = np.float32(2 * (twin.mirror.stroke_m or dm.stroke_m))
        self._ncpa = self._make_aberration(truth, twin.ncpa.rms_m, twin.ncpa.n_modes)
        self._vibration_phase = truth.uniform(0, 2 * np.pi, (2, len(twin.vibration.frequency_hz)))
        self._sensor: SensorOptics | None = None
        self.beam_path = BeamPath(config, truth.uniform(0, 2 * np.pi, 2))
        self._applied_modulation: object = self
        self._has_centre_drift = bool(twin.pyramid.drift)
        self.wfs_detector = Detector(
            (config.devices.wfs.region[3], config.devices.wfs.region[2]), config.devices.wfs.bit_depth,
            twin.wfs.full_well_e, twin.wfs.read_noise_e, twin.wfs.dark_e, twin.wfs.background,
            twin.wfs.fixed_pattern, np.random.default_rng(wfs_noise), twin.wfs.excess_noise,
        )  # fmt: skip
        self._seed_detector_noise(self.wfs_detector, 0)
        if self._run is not None:
            phases = np.random.default_rng(self._run_stream(2))
            self._vibration_phase = phases.uniform(0, 2 * np.pi, self._vibration_phase.shape)
        self._science_rng = np.random.default_rng(science_noise)
        self._exposures: _Exposures | None = None
        self.plates = PhasePlates(config, self.pupil, plates)
        self.atmosphere: Atmosphere | None = None
        if twin.atmosphere is not None:
            self.atmosphere = Atmosphere(twin.atmosphere, self.pupil.pixel_m, self.pupil.lit, sky)
        self.beam_blocked = False
        self.path_callbacks: list[Callable[[NDArray[np.float32], float], None]] = []

    # ------------------------------------------------------------------ clock
    @property
    def now_ns(self) -> int:
        """Simulated monotonic time in nanoseconds."""
        return self._clock_ns

    @property
    def now_s(self) -> float:
        """Simulated monotonic time in seconds."""
        return self._clock_ns * 1e-9

    def advance_to(self, time_s: float) -> None:
        """Advance the clock; if paced, wait for the wall clock."""
        self._clock_ns = max(self._clock_ns, round(time_s * 1e9))
        if self.config.twin.paced:
            wait = self._wall_start + self.now_s - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            elif wait < -_MAX_LAG_S:
                # A long lag (set-up, a long computation) is not caught up.
                self._wall_start -= wait

    # ------------------------------------------------------------------ mirror
    def drive(self, shape: NDArray[np.float64]) -> None:
        """Command a shape ``(n_act,)`` of the hardware; it arrives after the twin's latency and jitter."""
        twin = self.config.twin
        jitter = twin.latency_jitter_s * abs(self.latency_rng.standard_normal())
        self.dynamics.command(self.now_s + twin.latency_s + jitter, self._in_layout(shape))

    def set_positions(self, shape: NDArray[np.float64]) -> None:
        """Command a shape ``(n_act,)`` of the hardware without latency."""
        self.dynamics.command(self.now_s, self._in_layout(shape))

    def positions(self) -> NDArray[np.float64]:
        """Present displacements ``(n_act,)``, fractions of full stroke, as the hardware reports them."""
        shape = self.config.twin.mirror.polarity * self.dynamics.at(self.now_s)
        return shape if self._order is None else shape[self._order]

    def _in_layout(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """True numbering and sign of a shape of the hardware."""
        if self._order is None:
            return self.config.twin.mirror.polarity * shape
        return self.config.twin.mirror.polarity * shape[np.argsort(self._order)]

    # ------------------------------------------------------------------ beam
    def optical_path(self, start_s: float, end_s: float) -> NDArray[np.float32]:
        """Mean optical path ``(n, n)`` in metres over an exposure, common to both cameras."""
        middle = 0.5 * (start_s + end_s)
        opd = self.mirror_opd(self.dynamics.mean(start_s, end_s), middle)
        strength = self.seeing.strength(middle)
        self.plates.add(middle, opd, strength)
        if self.atmosphere is not None:
            self.atmosphere.add(middle, opd, strength)
        tip, tilt = self._vibration_tilt(middle)
        if tip or tilt:
            x = self.pupil.coordinates_m.astype(np.float32)
            opd += (np.float32(tip) * x)[None, :] + (np.float32(tilt) * x)[:, None]
        return opd

    def mirror_opd(self, command: NDArray[np.float64], time_s: float | None = None) -> NDArray[np.float32]:
        """Optical path ``(n, n)`` in metres of the settled mirror for a command ``(n_act,)``.

        ``time_s`` selects the registration, by default that of now.
        """
        opd = self._surface(command, self.now_s if time_s is None else time_s)
        opd *= self._opd_per_command_m
        return opd

    def sensor_opd(self, opd: NDArray[np.float32], time_s: float) -> NDArray[np.float32]:
        """Optical path ``(n, n)`` in metres at the sensor, with its non-common-path terms."""
        opd_at_sensor = opd + self._ncpa
        if self._has_centre_drift:
            opd_at_sensor += self._centre_drift_opd(time_s)
        return opd_at_sensor

    def wfs_image(self, start_s: float, end_s: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean intensity on the wavefront sensor over an exposure, and the last optical path."""
        sensor = self.sensor()
        steps = self.config.twin.substeps
        image = np.zeros((self.config.devices.wfs.region[3], self.config.devices.wfs.region[2]), np.float32)
        step = (end_s - start_s) / steps
        opd = np.zeros(0, np.float32)
        for k in range(steps):
            at = start_s + k * step
            opd = self.optical_path(at, at + step)
            sensor.frame(self.sensor_opd(opd, at), image)
        return (image / np.float32(steps) if steps > 1 else image), opd

    def wfs_light(self, exposure_s: float) -> tuple[float, float]:
        """Electrons of an exposure: from the source on the whole sensor, and from the sky per pixel."""
        twin, camera = self.config.twin, self.config.devices.wfs
        if self.beam_blocked:
            return 0.0, 0.0
        if twin.star is None:
            return self._throughput * twin.wfs.photons_per_frame * exposure_s / camera.exposure_s, 0.0
        sky = twin.star.sky_electrons(exposure_s) / (camera.region[2] * camera.region[3])
        return self._throughput * twin.star.electrons(exposure_s), self._throughput * sky

    def sensor(self) -> SensorOptics:
        """Optics of the sensor with the present modulation, built on first use."""
        if self._sensor is None:
            self._sensor = make_sensor_optics(self.config, self.pupil)
        change_key = self.beam_path.change_key
        if change_key is not self._applied_modulation:
            self._applied_modulation = change_key
            if isinstance(self._sensor, ModulatedOptics):
                self._sensor.modulation = self.beam_path.points()
        return self._sensor

    def _centre_drift_opd(self, time_s: float) -> NDArray[np.float32]:
        """Tilt ``(n, n)`` in metres by the drift of the modulation centre."""
        x, y = self.beam_path.drift(time_s) * self.config.system.wavelength_m / self.config.system.pupil_m
        at = self.pupil.coordinates_m
        return np.asarray(x * at[None, :] + y * at[:, None], np.float32)

    @property
    def science_section(self) -> ScienceConfig:
        """Configuration of the science camera; raises ConfigError if there is none."""
        section = self.config.devices.science
        if section is None:
            raise ConfigError(f"system {self.config.system.name!r} has no [devices.science] section")
        return section

    def focal_plane(self, shape: tuple[int, int]) -> FocalPlane:
        """Optics of the science camera for a region."""
        diameter_px = true_diameter(self.config) * self.pupil.n_pix
        wavelength_m, psf_px = self.config.system.wavelength_m, self.science_section.psf_px
        return FocalPlane(self.pupil.amplitude, diameter_px, wavelength_m, psf_px, shape)

    def science_detector(self, shape: tuple[int, int]) -> Detector:
        """Detector of the science camera for a region."""
        twin = self.config.twin.science
        detector = Detector(
            shape, self.science_section.bit_depth, twin.full_well_e, twin.read_noise_e, twin.dark_e,
            twin.background, twin.fixed_pattern, self._science_rng, twin.excess_noise,
        )  # fmt: skip
        self._seed_detector_noise(detector, 1)
        return detector

    def _run_stream(self, key: int) -> np.random.SeedSequence:
        if self._run is None:
            raise RuntimeError("this run has no seed of its own")
        return np.random.SeedSequence(self._run.entropy, spawn_key=(*self._run.spawn_key, 100 + key))

    def _seed_detector_noise(self, detector: Detector, key: int) -> None:
        """Give a detector its own noise stream of the run, if the run has a seed."""
        if self._run is not None:
            detector.set_rng(np.random.default_rng(self._run_stream(key)))

    # ------------------------------------------------------------------ science camera
    def start_integration(self, plane: FocalPlane, exposure_s: float, period_s: float) -> None:
        """Start integrating the focal plane, frame after frame."""
        self._exposures = _Exposures(plane, self.now_s, exposure_s, period_s)

    def stop_integration(self) -> None:
        """Stop integrating."""
        self._exposures = None

    def record_optical_path(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Pass the optical path of a time to the callbacks and the science camera."""
        for callback in self.path_callbacks:
            callback(opd, time_s)
        if self._exposures is not None:
            self._exposures.add_if_due(opd, time_s)

    def mean_image(self, number: int, end_s: float) -> NDArray[np.float32]:
        """Mean focal-plane intensity of science frame ``number``, which ends at ``end_s``."""
        exposures = self._exposures
        if exposures is None:
            raise RuntimeError("the science camera is not running")
        if not exposures.contains(number):
            # The wavefront sensor was not read meanwhile: sample the exposure at four times.
            for start in end_s - exposures.exposure_s * np.arange(4, 0, -1) / 4:
                exposures.add(
                    number, self.optical_path(float(start), float(start + exposures.exposure_s / 4))
                )
        return exposures.pop_mean(number)

    # ------------------------------------------------------------------ construction
    def _make_true_influence(self, truth: np.random.Generator) -> InfluenceModel:
        mirror = self.config.twin.mirror
        positions, pitch = actuator_positions(self.config), pitch_on_pupil(self.config)
        n, coupling = len(positions), mirror.coupling or self.config.devices.dm.coupling
        shape = mirror.true_shape
        if shape == "exponential":
            return draw_exponential(
                positions, pitch, truth, gain_scatter=mirror.gain_scatter,
                length_scatter=mirror.width_scatter, coupling=mirror.coupling,
            )  # fmt: skip
        if shape == "gaussian":
            wing = mirror.wing_fraction
            profile: tuple[tuple[float, float], ...] = SINGLE_GAUSSIAN
            if wing:
                profile = ((1 - wing, 1.0), (wing, _WING_WIDTH))
            return InfluenceFunctions(
                positions, pitch, coupling, width=1 + mirror.width_scatter * truth.standard_normal(n),
                gain=1 + mirror.gain_scatter * truth.standard_normal(n),
                profile=profile,
            )  # fmt: skip
        gain = 1 + mirror.gain_scatter * truth.standard_normal(n)
        if shape == "nominal":
            return nominal_influence_functions(self.config).with_gain(gain)
        if shape == "thin-plate":
            surfaces, pixel = thin_plate_surfaces(positions / pitch, coupling)
            return MeasuredInfluenceFunctions(surfaces, pixel * pitch, gain)
        if mirror.influence_pixel_m is None:
            raise ConfigError("twin.mirror.influence_pixel_m is required with twin.mirror.influence_file")
        pixel = mirror.influence_pixel_m
        surfaces = fill_gaps(read_cube(mirror.influence_file, n), pitch / pixel)
        return MeasuredInfluenceFunctions(surfaces, pixel, gain)

    def _make_aberration(self, truth: np.random.Generator, rms_m: float, n_modes: int) -> NDArray[np.float32]:
        """Random low-order polynomials, orthonormal over the pupil, of ``rms_m`` over it."""
        lit = self.pupil.lit
        unit = self.pupil.coordinates_m / (self.config.system.pupil_m / 2)
        x, y = np.meshgrid(unit, unit)
        powers = [(i, k - i) for k in range(32) for i in range(k + 1)][: n_modes + 3]
        basis = np.stack([(x**i * y**j)[lit] for i, j in powers], axis=1)
        # Piston, tip and tilt are omitted: they are alignment, not aberration.
        modes = np.linalg.qr(basis)[0][:, 3:]
        aberration = np.zeros(lit.shape, np.float32)
        if rms_m and modes.shape[1]:
            mix = modes @ (truth.standard_normal(modes.shape[1]) / np.arange(1, modes.shape[1] + 1) ** 0.5)
            aberration[lit] = mix * (rms_m / mix.std())
        return aberration

    def _vibration_tilt(self, time_s: float) -> tuple[float, float]:
        """Tip and tilt of the beam in radians."""
        vib = self.config.twin.vibration
        f = np.asarray(vib.frequency_hz)
        tip, tilt = (
            np.asarray(vib.amplitude_rad) * np.sin(2 * np.pi * f * time_s + self._vibration_phase)
        ).sum(1)
        return float(tip), float(tilt)


class _Exposures:
    """Sums of focal-plane images, one per science frame.

    A late reader gets the newest complete frame. Sums of older frames are discarded, so that the memory does
    not grow while the science camera runs and is not read.
    """

    #: Wavefront-sensor frames per sample of the focal plane.
    STRIDE = 4
    #: Sums that are kept: the frame being exposed, the newest complete one, and one for rounded times.
    MAX_SUMS = 3

    def __init__(self, plane: FocalPlane, start_s: float, exposure_s: float, period_s: float) -> None:
        self._plane, self._start, self.exposure_s, self._period = plane, start_s, exposure_s, period_s
        self._sums: dict[int, tuple[NDArray[np.float32], int]] = {}
        self._frame_count = 0

    def contains(self, number: int) -> bool:
        return number in self._sums

    def add_if_due(self, opd: NDArray[np.float32], time_s: float) -> None:
        self._frame_count = (self._frame_count + 1) % self.STRIDE
        number, phase_s = divmod(time_s - self._start, self._period)
        if self._frame_count == 0 and number >= 0 and phase_s <= self.exposure_s:
            self.add(int(number), opd)

    def add(self, number: int, opd: NDArray[np.float32]) -> None:
        image = self._plane.image(opd)
        total, count = self._sums.get(number, (np.zeros_like(image), 0))
        self._sums[number] = (total + image, count + 1)
        self._discard_before(number - self.MAX_SUMS + 1)

    def pop_mean(self, number: int) -> NDArray[np.float32]:
        total, count = self._sums.pop(number)
        self._discard_before(number)
        return np.asarray(total / np.float32(count))

    def _discard_before(self, number: int) -> None:
        for old in [k for k in self._sums if k < number]:
            del self._sums[old]
