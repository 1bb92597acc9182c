"""Setting up the sensor from its own frames: background, grid, references."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief
from escape_hw.api.camera import Camera
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import some_frames
from escape_hw.calibration.basis import configured_basis
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.pokes import equal_snr
from escape_hw.calibration.sensor_kinds import kind_of
from escape_hw.errors import CalibrationError, ConfigError

#: Frames whose mean the grid is found on.
SETUP_FRAMES = 200


@dataclass(frozen=True, slots=True, eq=False)
class SensorSetup:
    """What the sensor's frames say about it: its geometry, and the mean frame that was found on."""

    grid: SensorGeometry
    mean_frame: NDArray[np.float32]
    __repr__ = brief


def prepare_sensor(bench: Bench) -> None:
    """Make the sensor ready for a measurement: a pyramid's modulator turns as configured.

    Raises
    ------
    SettingRejected, DeviceError
        The modulator cannot do that, or did not start.
    """
    kind_of(bench).prepare(bench)


def setup_from_frames(
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
    kind = kind_of(bench)
    background = kind.background(mean_frame) if bench.dark is None else 0.0
    grid = kind.find(bench, _calibrated(bench, mean_frame, background), references)
    return SensorSetup(grid.with_background(background), mean_frame)


def refined(bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]) -> SensorGeometry:
    """A geometry, better known by the mean raw frames of a run's parts."""
    return kind_of(bench).refined(bench, grid, [_calibrated(bench, mean, grid.background) for mean in means])


def _calibrated(bench: Bench, frame: NDArray[np.float32], background: float) -> NDArray[np.float32]:
    """A raw frame without dark and flat."""
    clean = frame - (background if bench.dark is None else bench.dark)
    return np.asarray(clean if bench.flat is None else clean / bench.flat, np.float32)


def extractor(bench: Bench, grid: SensorGeometry) -> SlopeFunction:
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
    slopes_of = kind_of(bench).extractor(bench, grid, shape, dark)
    if bench.taps.geometry is not None:
        bench.taps.geometry(grid)
    return slopes_of if bench.taps.slopes is None else _TappedSlopes(slopes_of, bench.wfs, bench.taps.slopes)


class _TappedSlopes:
    """Slopes that somebody looks at as they pass."""

    def __init__(
        self, slopes_of: SlopeFunction, camera: Camera, tap: Callable[[int, NDArray[np.float32]], object]
    ) -> None:
        self._slopes_of, self._camera, self._tap = slopes_of, camera, tap
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
        self._tap(self._camera.last_index, slopes)
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
    some_frames(frames)
    prepare_sensor(bench)
    total = np.zeros((), np.float64)
    report = Reporter(f"find the {kind_of(bench).sought}", frames)
    for done in range(frames):
        total = total + bench.wfs.next_frame(bench.config.devices.wfs.timeout_s).data
        if report.due():
            yield report(done + 1)
    return setup_from_frames(bench, (total / frames).astype(np.float32), references)


def ready_sensor(
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
    some_frames(frames)
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


def modal_basis(bench: Bench) -> NDArray[np.float64]:
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
    return configured_basis(bench.config, surfaces, pupil, pixel, bench.dm.limits.disabled)


def poke_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
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
    return np.asarray(np.minimum(poke, _most(bench, m2c)))


def random_amplitudes(bench: Bench, m2c: NDArray[np.float64], poke: float) -> NDArray[np.float64]:
    """As :func:`poke_amplitudes`, for random pokes on all modes at once.

    With ``calibration.pokes = "equal-snr"`` the modes share the same Strehl budget by what is seen of
    them (:func:`~.pokes.equal_snr`).
    """
    usual = poke_amplitudes(bench, m2c, poke)
    if bench.config.calibration.pokes != "equal-snr":
        return usual
    return equal_snr(modal_matrix(bench.model(), Registration(), m2c), _most(bench, m2c), poke)


def _most(bench: Bench, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Amplitude of each mode at which an actuator takes ``calibration.poke_command``."""
    return np.asarray(bench.config.calibration.poke_command / np.abs(m2c).max(axis=0))
