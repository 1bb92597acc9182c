"""Set-up of the wavefront sensor from its own frames: dark frame, geometry, references and slope function, for each kind of sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera
from escape_hw.api.modulator import Modulation
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.representation import short_repr
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid, require_kind
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.calibration.acquisition.pokes import equal_snr_amplitudes
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.config.sensor import PyramidSection, ShackHartmannSection
from escape_hw.errors import CalibrationError, ConfigError, IncompatibleProduct
from escape_hw.pipeline.geometry.lenslet_grid import find_lenslet_grid
from escape_hw.pipeline.geometry.obscuration import build_shadow
from escape_hw.pipeline.geometry.pupil_images import find_pupil_images, refine_pupil_images
from escape_hw.pipeline.slopes.pyramid import PyramidSlopes
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes

#: A geometry's modulation and the one in force may differ by this share.
_MODULATION_TOLERANCE = 0.01


class SensorKind(Protocol):
    """A kind of sensor.

    Attributes
    ----------
    sought
        What is looked for on its frames, for progress reports.
    source_references
        ``"mean"`` or ``"design"``: the references to take on a calibration source.
    long_look
        True when the mean frame of a whole run tells more of the geometry than its first frames do.
    """

    search_target: str
    source_references: str
    uses_run_mean: bool

    def prepare(self, bench: Bench) -> None:
        """Make the sensor ready for frames that mean something."""
        ...

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Level of the pixels that no light reaches, in counts."""
        ...

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> SensorGeometry:
        """The geometry on a calibrated mean frame; ``references`` is ``"design"`` or ``"mean"``."""
        ...

    def refine_geometry(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> SensorGeometry:
        """The geometry, better known by calibrated mean frames of a run's parts; its slopes stay the same."""
        ...

    def build_slope_function(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> SlopeFunction:
        """What turns this camera's frames into slopes."""
        ...


class _ShackHartmann:
    """Lenslets: spots on a lattice."""

    search_target = "lenslet grid"
    # Lenslets stand regularly; what their spots lack of it is the aberration that a loop should take out.
    source_references = "design"
    uses_run_mean = False

    def __init__(self, section: ShackHartmannSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Nothing moves in a Shack-Hartmann sensor."""

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Median of the darkest fifth: between the spots and outside the pupil a frame is dark."""
        return _estimate_dark_level(mean_frame)

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> SubApertureGrid:
        return find_lenslet_grid(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_pitch_px=self._section.pitch_px,
            threshold=self._threshold(bench),
            min_flux=self._section.min_flux,
            references="lattice" if references == "design" else references,
        )

    def refine_geometry(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> SensorGeometry:
        """As it is: the mean slopes of the run already tell all that its mean frame does."""
        return grid

    def build_slope_function(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> ShackHartmannSlopes:
        lenslets = require_kind(grid, SubApertureGrid)
        centres, half = lenslets.centres_px(), lenslets.pitch_px / 2
        if (centres < half - 1).any() or (centres > np.array(shape[::-1]) - half).any():
            raise IncompatibleProduct(_region_message("lenslet grid reaches", shape))
        return ShackHartmannSlopes(
            lenslets, shape, dark=dark, flat=bench.flat, threshold=self._threshold(bench)
        )

    def _threshold(self, bench: Bench) -> float:
        """Centre-of-gravity threshold in counts above the background."""
        return self._section.threshold * bench.wfs.info.full_scale


class _Pyramid:
    """A pyramid: four pupil images, and a modulator that has to turn."""

    search_target = "pupil images"
    # A pyramid has no lattice to go by; on a source, what the sensor shows is the flat wavefront.
    source_references = "mean"
    uses_run_mean = True

    def __init__(self, section: PyramidSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Modulate as configured, unless that is what the modulator does already."""
        modulator, modulator_section = bench.modulator, bench.config.devices.modulator
        if modulator is None or modulator_section is None:
            return
        if not self._section.modulation:
            modulator.park()
            return
        radius = self._section.modulation * modulator_section.rad_per_lambda_d
        requested = modulator.check(Modulation(radius, modulator_section.frequency_hz))
        if modulator.modulation != requested:
            modulator.modulate(requested)

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Median of the darkest fifth: the corners between and beside the images."""
        return _estimate_dark_level(mean_frame)

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> PyramidPupils:
        return find_pupil_images(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_px=np.array(self._section.pupils_px),
            min_flux=self._section.min_flux,
            normalisation=self._section.normalisation,
            modulation=current_modulation(bench),
            references=references,
        )

    def refine_geometry(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> PyramidPupils:
        """Rims and shadow on the mean of the whole run: turbulence averages out."""
        shadow = build_shadow(bench.config.telescope, bench.config.system.pupil_m)
        return refine_pupil_images(means, require_kind(grid, PyramidPupils), shadow)

    def build_slope_function(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> PyramidSlopes:
        pupils = require_kind(grid, PyramidPupils)
        corners, n = pupils.corners_px, pupils.valid.shape[0]
        if (corners < 0).any() or (corners + n > np.array(shape[::-1])).any():
            raise IncompatibleProduct(_region_message("pupil images reach", shape))
        now = current_modulation(bench)
        if abs(now - pupils.modulation) > _MODULATION_TOLERANCE * max(now, pupils.modulation):
            raise IncompatibleProduct(
                f"the pupil images were measured with a modulation of {pupils.modulation:.4g} lambda/D, "
                f"the modulator does {now:.4g}; measure again, or set sensor.modulation"
            )
        return PyramidSlopes(pupils, shape, dark=dark, flat=bench.flat)


def current_modulation(bench: Bench) -> float:
    """Radius of the modulation as the modulator reports it, in lambda/D; 0 when it is parked."""
    section = bench.config.devices.modulator
    now = None if bench.modulator is None else bench.modulator.modulation
    return 0.0 if now is None or section is None else now.radius_rad / section.rad_per_lambda_d


def get_sensor_kind(bench: Bench) -> SensorKind:
    """The kind of sensor of a bench."""
    section = bench.config.sensor
    return _Pyramid(section) if isinstance(section, PyramidSection) else _ShackHartmann(section)


def _estimate_dark_level(mean_frame: NDArray[np.float32]) -> float:
    """Median of the darkest fifth of the pixels, which leaves out the wings of what is bright."""
    darkest = np.sort(mean_frame.ravel())[: max(1, mean_frame.size // 5)]
    return float(np.median(darkest))


def _region_message(what: str, shape: tuple[int, int]) -> str:
    return (
        f"the {what} beyond the camera's region of {shape[1]} x {shape[0]} pixels; "
        "it was found on another region, so measure again"
    )


#: Frames whose mean the grid is found on.
SETUP_FRAMES = 200


@dataclass(frozen=True, slots=True, eq=False)
class SensorSetup:
    """What the sensor's frames say about it: its geometry, and the mean frame that was found on."""

    grid: SensorGeometry
    mean_frame: NDArray[np.float32]
    __repr__ = short_repr


def prepare_sensor(bench: Bench) -> None:
    """Make the sensor ready for a measurement: a pyramid's modulator turns as configured.

    Raises
    ------
    SettingRejected, DeviceError
        The modulator cannot do that, or did not start.
    """
    get_sensor_kind(bench).prepare(bench)


def build_sensor_setup(
    bench: Bench, mean_frame: NDArray[np.float32], references: str = "design"
) -> SensorSetup:
    """Find the sensor's geometry on a mean frame.

    Parameters
    ----------
    bench
        Gives the design of the sensor and, when it was measured, the dark frame.
    mean_frame
        Mean of raw frames in counts ``(rows, columns)``.
    references
        See :func:`find_sensor`.
    """
    kind = get_sensor_kind(bench)
    background = kind.background(mean_frame) if bench.dark is None else 0.0
    grid = kind.find(bench, _calibrate_frame(bench, mean_frame, background), references)
    return SensorSetup(grid.with_background(background), mean_frame)


def refine_geometry(
    bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
) -> SensorGeometry:
    """A geometry, better known by the mean raw frames of a run's parts."""
    return get_sensor_kind(bench).refine_geometry(
        bench, grid, [_calibrate_frame(bench, mean, grid.background) for mean in means]
    )


def _calibrate_frame(bench: Bench, frame: NDArray[np.float32], background: float) -> NDArray[np.float32]:
    """A raw frame without dark and flat."""
    clean = frame - (background if bench.dark is None else bench.dark)
    return np.asarray(clean if bench.flat is None else clean / bench.flat, np.float32)


def build_slope_function(bench: Bench, grid: SensorGeometry) -> SlopeFunction:
    """Slopes of this bench's camera on a geometry.

    Raises
    ------
    IncompatibleProduct
        The geometry leaves the camera's region, or is that of another kind of sensor.
    CalibrationError
        The dark frame is of another region.
    """
    region = bench.wfs.settings.region
    shape = (region.height, region.width)
    if bench.dark is not None and bench.dark.shape != shape:
        raise CalibrationError(
            f"the dark frame has shape {bench.dark.shape}, the camera delivers {shape}; measure it again"
        )
    dark = bench.dark if bench.dark is not None else np.full(shape, grid.background, np.float32)
    slopes_of = get_sensor_kind(bench).build_slope_function(bench, grid, shape, dark)
    if bench.callbacks.geometry is not None:
        bench.callbacks.geometry(grid)
    return (
        slopes_of
        if bench.callbacks.slopes is None
        else _ObservedSlopeFunction(slopes_of, bench.wfs, bench.callbacks.slopes)
    )


class _ObservedSlopeFunction:
    """Slopes that somebody looks at as they pass."""

    def __init__(
        self, slopes_of: SlopeFunction, camera: Camera, callback: Callable[[int, NDArray[np.float32]], object]
    ) -> None:
        self._slopes_of, self._camera, self._callback = slopes_of, camera, callback
        self.grid, self.shape = slopes_of.grid, slopes_of.shape

    @property
    def flux(self) -> NDArray[np.float32]:
        return self._slopes_of.flux

    def __call__(
        self,
        frame: NDArray[np.uint16],
        flux: NDArray[np.float32] | None = None,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        slopes = self._slopes_of(frame, flux, out)
        self._callback(self._camera.last_index, slopes)
        return slopes


def find_sensor(
    bench: Bench, *, frames: int = SETUP_FRAMES, references: str = "design"
) -> Procedure[SensorSetup]:
    """Watch the sensor for a while and find its geometry.

    Parameters
    ----------
    bench
        An open bench.
    frames
        Frames to average.
    references
        ``"design"``: what a flat wavefront shows on a sensor as designed (the choice under
        turbulence); ``"mean"``: what the frames show (for a source whose wavefront is flat).

    Raises
    ------
    CalibrationError
        No spots or pupil images where the design says there should be.
    """
    validate_frame_count(frames)
    prepare_sensor(bench)
    total = np.zeros((), np.float64)
    report = Reporter(f"find the {get_sensor_kind(bench).search_target}", frames)
    for done in range(frames):
        total = total + bench.wfs.next_frame(bench.config.devices.wfs.timeout_s).data
        if report.due():
            yield report(done + 1)
    return build_sensor_setup(bench, (total / frames).astype(np.float32), references)


def ensure_sensor_ready(
    bench: Bench, grid: SensorGeometry | None, references: str = "design"
) -> Procedure[tuple[SensorGeometry, NDArray[np.float32] | None]]:
    """Flatten the mirror, make the sensor ready, and find its geometry unless it is known.

    Parameters
    ----------
    bench
        An open bench.
    grid
        The geometry, when it is known.
    references
        As for :func:`find_sensor`.

    Returns
    -------
    grid : SensorGeometry
    mean_frame : ndarray or None
        The mean frame it was found on; ``None`` if it was known.

    Raises
    ------
    CalibrationError
        No spots or pupil images where the design says there should be.
    """
    bench.dm.flatten()
    prepare_sensor(bench)
    if grid is not None:
        return grid, None
    setup = yield from find_sensor(bench, references=references)
    return setup.grid, setup.mean_frame


def measure_dark(bench: Bench, *, frames: int = 100) -> Procedure[NDArray[np.float32]]:
    """Mean dark frame, with the beam stop in; kept as ``bench.dark``.

    Raises
    ------
    CalibrationError
        The system has no beam stop that can be moved by command.
    """
    if bench.screen is None:
        raise CalibrationError(
            "this system has no beam stop under control; block the beam by hand and set bench.dark"
        )
    validate_frame_count(frames)
    total = np.zeros((), np.float64)
    report = Reporter("dark frame", frames)
    before = bench.screen.state.blocked
    bench.screen.set(blocked=True)
    try:
        for _ in range(3):
            # Frames that began before the stop was in.
            bench.wfs.next_frame(bench.config.devices.wfs.timeout_s)
        for done in range(frames):
            total = total + bench.wfs.next_frame(bench.config.devices.wfs.timeout_s).data
            if report.due():
                yield report(done + 1)
    finally:
        bench.screen.set(blocked=before)
    bench.dark = (total / frames).astype(np.float32)
    return bench.dark


def build_modal_basis(bench: Bench) -> NDArray[np.float64]:
    """Mode-to-command matrix ``(n_act, n_modes)`` that the configuration asks for.

    Raises
    ------
    ConfigError
        The basis does not fit the mirror, or moves disabled actuators.
    CalibrationError
        More modes than the actuators that work can make.
    """
    surfaces, pupil, pixel = bench.model().influence_functions()
    if surfaces.shape[0] != bench.dm.info.n_act:
        raise ConfigError(f"the model has {surfaces.shape[0]} actuators, the mirror {bench.dm.info.n_act}")
    return build_basis(bench.config, surfaces, pupil, pixel, bench.dm.limits.disabled)


def compute_poke_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """Amplitude of each mode's poke ``(n_modes,)``, rms surface as fraction of full stroke.

    Modes that the mirror makes with large commands (those that live at the pupil's rim) are poked
    less, so that no single mode takes more than ``calibration.poke_command`` of any actuator.

    Raises
    ------
    ConfigError
        The poke is not in (0, 1].
    """
    if not 0 < poke <= 1:
        raise ConfigError(f"poke is {poke}; it must lie in (0, 1], rms surface as fraction of full stroke")
    return np.asarray(np.minimum(poke, _max_amplitudes(bench, m2c)))


def compute_random_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """As :func:`compute_poke_amplitudes`, for random pokes on all modes at once.

    With ``calibration.pokes = "equal-snr"`` the modes share the same Strehl budget by what is seen of
    them (:func:`~.pokes.equal_snr_amplitudes`).
    """
    amplitudes = compute_poke_amplitudes(bench, m2c, poke)
    if bench.config.calibration.pokes != "equal-snr":
        return amplitudes
    return equal_snr_amplitudes(
        modal_matrix(bench.model(), Registration(), m2c), _max_amplitudes(bench, m2c), poke
    )


def _max_amplitudes(bench: Bench, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of each mode at which an actuator takes ``calibration.poke_command``."""
    return np.asarray(bench.config.calibration.poke_command / np.abs(m2c).max(axis=0))
