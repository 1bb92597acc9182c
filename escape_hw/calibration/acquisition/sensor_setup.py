"""Set-up of the wavefront sensor from its frames: dark frame, geometry, references, slope function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.api.modulator import Modulation
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.representation import short_repr
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid, require_kind
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import next_frame, validate_frame_count
from escape_hw.config.sensor import PyramidSection, ShackHartmannSection
from escape_hw.errors import CalibrationError, IncompatibleProduct
from escape_hw.pipeline.geometry.lenslet_grid import find_lenslet_grid
from escape_hw.pipeline.geometry.obscuration import build_shadow
from escape_hw.pipeline.geometry.pupil_images import find_pupil_images, refine_pupil_images
from escape_hw.pipeline.slopes.pyramid import PyramidSlopes
from escape_hw.pipeline.slopes.shack_hartmann import ShackHartmannSlopes
from escape_hw.pipeline.statistics import root_mean_square

#: Pixels over which a frame is smoothed to find its dark parts, and their largest share of a lenslet: where
#: all lenslets are lit, the dark parts are those between the spots.
_SMOOTHING_PX, _SMOOTHING_SHARE = 9, 0.6
#: Frames whose mean the geometry is found on.
SETUP_FRAMES = 200
#: Relative difference allowed between the modulation of a geometry and the one in force.
_MODULATION_TOLERANCE = 0.01


class _ShackHartmann:
    """Lenslets: spots on a lattice.

    ``search_target`` is what is found on mean frames; ``source_references`` are the references on a
    calibration source, ``"mean"`` or ``"design"``; ``uses_run_mean``: the mean frame of a whole run improves
    the geometry found on its first frames.
    """

    search_target = "lenslet grid"
    # The lenslets are regular; deviations of their spots are aberrations, which a loop should correct.
    source_references = "design"
    uses_run_mean = False

    def __init__(self, section: ShackHartmannSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Nothing moves in a Shack-Hartmann sensor."""

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> SubApertureGrid:
        return find_lenslet_grid(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_pitch_px=self._section.pitch_px,
            threshold=self._threshold(bench),
            min_flux=self._section.min_flux,
            references="lattice" if references == "design" else references,
            valid=self._section.valid_map(),
        )

    def refine_geometry(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> SensorGeometry:
        """Return the geometry as it is: the mean slopes contain all that the mean frames do."""
        return grid

    def build_slope_function(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> ShackHartmannSlopes:
        lenslets = require_kind(grid, SubApertureGrid)
        centres, half = lenslets.centres_px(), lenslets.pitch_px / 2
        if (centres < half - 1).any() or (centres > np.array(shape[::-1]) - half).any():
            raise IncompatibleProduct(_region_message("lenslet grid extends", shape))
        return ShackHartmannSlopes(
            lenslets, shape, dark=dark, flat=bench.flat, threshold=self._threshold(bench)
        )

    @property
    def smoothing_px(self) -> int:
        """Pixels over which a frame is smoothed to find its dark parts."""
        return max(1, min(_SMOOTHING_PX, int(_SMOOTHING_SHARE * self._section.pitch_px)))

    def _threshold(self, bench: Bench) -> float:
        """Centre-of-gravity threshold in counts above the background."""
        return self._section.threshold * bench.wfs.info.full_scale


class _Pyramid:
    """A pyramid: four pupil images, and a modulator; attributes as for :class:`_ShackHartmann`."""

    search_target = "pupil images"
    # A pyramid has no lattice; on a source its slopes are those of the flat wavefront.
    source_references = "mean"
    uses_run_mean = True
    smoothing_px = _SMOOTHING_PX

    def __init__(self, section: PyramidSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Modulate as configured, unless the modulator does so already."""
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

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> PyramidPupils:
        return find_pupil_images(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_px=np.array(self._section.pupils_px),
            min_flux=self._section.min_flux,
            normalisation=self._section.normalisation,
            modulation=_current_modulation(bench),
            references=references,
        )

    def refine_geometry(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> PyramidPupils:
        """Fit rims and shadow on the mean of the whole run, in which turbulence averages out."""
        shadow = build_shadow(bench.config.telescope, bench.config.system.pupil_m)
        return refine_pupil_images(means, require_kind(grid, PyramidPupils), shadow)

    def build_slope_function(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> PyramidSlopes:
        pupils = require_kind(grid, PyramidPupils)
        corners, n = pupils.corners_px, pupils.valid.shape[0]
        if (corners < 0).any() or (corners + n > np.array(shape[::-1])).any():
            raise IncompatibleProduct(_region_message("pupil images extend", shape))
        now = _current_modulation(bench)
        if abs(now - pupils.modulation) > _MODULATION_TOLERANCE * max(now, pupils.modulation):
            raise IncompatibleProduct(
                f"the pupil images were measured with a modulation of {pupils.modulation:.4g} lambda/D, "
                f"the modulator does {now:.4g}; measure again, or set sensor.modulation"
            )
        return PyramidSlopes(pupils, shape, dark=dark, flat=bench.flat)


def _current_modulation(bench: Bench) -> float:
    """Radius of the modulation as the modulator reports it, in lambda/D; 0 when it is parked."""
    section = bench.config.devices.modulator
    now = None if bench.modulator is None else bench.modulator.modulation
    return 0.0 if now is None or section is None else now.radius_rad / section.rad_per_lambda_d


def get_sensor_kind(bench: Bench) -> _Pyramid | _ShackHartmann:
    """What differs between kinds of wavefront sensors, for the sensor of a bench."""
    section = bench.config.sensor
    return _Pyramid(section) if isinstance(section, PyramidSection) else _ShackHartmann(section)


def find_darkest_pixels(mean_frame: NDArray[np.float32], smoothing_px: int) -> NDArray[np.intp]:
    """Flat indices of the pixels without light: the darkest fifth of a smoothed frame.

    These are the pixels outside the pupil, without the wings of bright spots. Smoothing makes the choice of
    the darkest independent of the fixed pattern, which would otherwise lower the level.
    """
    smooth = ndimage.uniform_filter(mean_frame.astype(np.float32), smoothing_px)
    return np.argsort(smooth.ravel())[: max(1, mean_frame.size // 5)]


def _region_message(what: str, shape: tuple[int, int]) -> str:
    return (
        f"the {what} beyond the camera's region of {shape[1]} x {shape[0]} pixels; "
        "it was found on another region, so measure again"
    )


@dataclass(frozen=True, slots=True, eq=False)
class SensorSetup:
    """Geometry of the sensor, and the mean frame in counts ``(rows, columns)`` that it was found on."""

    grid: SensorGeometry
    mean_frame: NDArray[np.float32]
    __repr__ = short_repr


def prepare_sensor(bench: Bench) -> None:
    """Set the sensor up for a measurement: start or park a pyramid's modulator as configured.

    Raises
    ------
    SettingRejected, DeviceError
        The modulator cannot do what the configuration asks for, or did not start.
    """
    get_sensor_kind(bench).prepare(bench)


def build_sensor_setup(
    bench: Bench,
    mean_frame: NDArray[np.float32],
    references: str = "design",
    *,
    frame: NDArray[np.uint16] | None = None,
) -> SensorSetup:
    """Find the sensor's geometry on a mean frame.

    Parameters
    ----------
    bench
        Bench with the design of the sensor and, if it was measured, the dark frame. Without one the
        background is estimated from the darkest pixels.
    mean_frame
        Mean of raw frames in counts ``(rows, columns)``.
    frame
        One of these frames, from which the noise of the pixels is estimated.

    Raises
    ------
    CalibrationError
        No spots or pupil images where the design has them.
    """
    kind = get_sensor_kind(bench)
    darkest = find_darkest_pixels(mean_frame, kind.smoothing_px)
    background = float(np.median(mean_frame.ravel()[darkest])) if bench.dark is None else 0.0
    calibrated = _calibrate_frame(bench, mean_frame, background)
    grid = kind.find(bench, calibrated, references)
    if frame is not None:
        grid = grid.with_pixel_noise(root_mean_square((frame - mean_frame).ravel()[darkest]))
    return SensorSetup(grid.with_background(background), mean_frame)


def refine_geometry(
    bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
) -> SensorGeometry:
    """Improve a geometry by the mean raw frames of a run's parts."""
    return get_sensor_kind(bench).refine_geometry(
        bench, grid, [_calibrate_frame(bench, mean, grid.background) for mean in means]
    )


def _calibrate_frame(bench: Bench, frame: NDArray[np.float32], background: float) -> NDArray[np.float32]:
    """Subtract the dark frame, or the background without one, and divide by the flat."""
    clean = frame - (background if bench.dark is None else bench.dark)
    return np.asarray(clean if bench.flat is None else clean / bench.flat, np.float32)


def build_slope_function(bench: Bench, grid: SensorGeometry) -> SlopeFunction:
    """Build the slope function of this bench's camera for a geometry.

    Raises
    ------
    IncompatibleProduct
        The geometry extends beyond the camera's region, or is that of another kind of sensor or modulation.
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
    callbacks = bench.callbacks
    if callbacks.geometry is not None:
        callbacks.geometry(grid)
    if callbacks.slopes is not None:
        observer, camera = callbacks.slopes, bench.wfs
        slopes_of.observer = lambda slopes: observer(camera.last_index, slopes)
    return slopes_of


def find_sensor(
    bench: Bench, *, frames: int = SETUP_FRAMES, references: str = "design"
) -> Procedure[SensorSetup]:
    """Average frames of the sensor and find its geometry on the mean.

    Parameters
    ----------
    frames
        Number of frames to average.
    references
        ``"design"``: slopes of a flat wavefront on a sensor as designed (under turbulence); ``"mean"``: the
        slopes of the frames (on a source with a flat wavefront).

    Raises
    ------
    ConfigError
        The number of frames is not at least 1.
    CalibrationError
        No spots or pupil images where the design has them.
    """
    validate_frame_count(frames)
    prepare_sensor(bench)
    stage = f"find the {get_sensor_kind(bench).search_target}"
    mean, last = yield from _average_frames(bench, frames, stage)
    return build_sensor_setup(bench, mean, references, frame=last)


def _average_frames(
    bench: Bench, frames: int, stage: str
) -> Procedure[tuple[NDArray[np.float32], NDArray[np.uint16]]]:
    """Mean and last of a number of frames."""
    total, report = np.zeros((), np.float64), Reporter(stage, frames)
    for done in range(frames):
        data = next_frame(bench).data
        total = total + data
        if report.is_due():
            yield report(done + 1)
    return (total / frames).astype(np.float32), data


def ensure_sensor_ready(
    bench: Bench, grid: SensorGeometry | None, references: str = "design"
) -> Procedure[tuple[SensorGeometry, NDArray[np.float32] | None]]:
    """Flatten the mirror, prepare the sensor, and find its geometry unless it is given.

    Returns
    -------
    grid : SensorGeometry
    mean_frame : ndarray or None
        Mean frame that the geometry was found on; ``None`` if it was given.

    Raises
    ------
    CalibrationError
        No spots or pupil images where the design has them.
    """
    bench.dm.flatten()
    prepare_sensor(bench)
    if grid is not None:
        return grid, None
    setup = yield from find_sensor(bench, references=references)
    return setup.grid, setup.mean_frame


def measure_dark(
    bench: Bench, *, frames: int = 100, blocked_by_hand: bool = False
) -> Procedure[NDArray[np.float32]]:
    """Measure the mean dark frame with the beam stop in, and set it as ``bench.dark``.

    Parameters
    ----------
    frames
        Frames to average.
    blocked_by_hand
        The beam is blocked already; needed where the beam stop is not under remote control.

    Returns
    -------
    ndarray of float32, ``(rows, columns)``
        In counts.

    Raises
    ------
    ConfigError
        The number of frames is not at least 1.
    CalibrationError
        The system has no beam stop under remote control, and the beam was not blocked by hand.
    """
    validate_frame_count(frames)
    if blocked_by_hand:
        bench.dark, _ = yield from _average_frames(bench, frames, "dark frame")
        return bench.dark
    if bench.screen is None:
        raise CalibrationError(
            "this system has no beam stop under remote control; block the beam by hand, or point beside the "
            "star, and say so (blocked_by_hand), or name a dark frame in devices.wfs.dark_file"
        )
    before = bench.screen.state.blocked
    bench.screen.set(blocked=True)
    try:
        for _ in range(3):
            # Frames whose exposure began before the beam was blocked.
            next_frame(bench)
        bench.dark, _ = yield from _average_frames(bench, frames, "dark frame")
    finally:
        bench.screen.set(blocked=before)
    return bench.dark


#: Range of the relative response of a working pixel, and largest share of pixels outside of it in a flat.
_PIXEL_RESPONSE, _MAX_DEFECTIVE_SHARE = (0.5, 1.5), 0.01


def compute_flat(mean_frame: NDArray[np.float32], dark: NDArray[np.float32]) -> NDArray[np.float32]:
    """Relative response of the pixels ``(rows, columns)``, mean 1, from a mean frame in uniform light.

    Pixels whose response is less than half or more than 1.5 times the mean count as defective and get 1.

    Raises
    ------
    CalibrationError
        There is no light above the dark frame, or it is not uniform: more than 1 % of the pixels differ from
        the mean by more than half of it.
    """
    light = mean_frame.astype(np.float64) - dark
    level = float(np.median(light))
    if level <= 0:
        raise CalibrationError("no light above the dark frame; illuminate the whole camera uniformly")
    response = light / level
    low, high = _PIXEL_RESPONSE
    defective = (response < low) | (response > high)
    share = float(defective.mean())
    if share > _MAX_DEFECTIVE_SHARE:
        raise CalibrationError(
            f"{100 * share:.1f} % of the pixels differ from the mean by more than half of it; a flat needs "
            "uniform light on the whole camera"
        )
    response[defective] = 1.0
    return np.asarray(response / response.mean(), np.float32)


def measure_flat(bench: Bench, *, frames: int = 100) -> Procedure[NDArray[np.float32]]:
    """Measure the relative response of the pixels in uniform light, and set it as ``bench.flat``.

    Raises
    ------
    ConfigError
        The number of frames is not at least 1.
    CalibrationError
        There is no dark frame, or see :func:`compute_flat`.
    """
    validate_frame_count(frames)
    if bench.dark is None:
        raise CalibrationError("no dark frame: measure it first, or name it in devices.wfs.dark_file")
    mean, _ = yield from _average_frames(bench, frames, "flat")
    bench.flat = compute_flat(mean, bench.dark)
    return bench.flat
