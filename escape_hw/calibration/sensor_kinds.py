"""What finding a sensor and reading its slopes takes, for each kind of sensor.

This is the only place of the core that tells kinds of sensors apart by their configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.modulator import Modulation
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid, of_kind
from escape_hw.bench import Bench
from escape_hw.config.sensor_models import PyramidSection, ShackHartmannSection
from escape_hw.errors import IncompatibleProduct
from escape_hw.pipeline.grid import find_grid
from escape_hw.pipeline.obscuration import shadow_of
from escape_hw.pipeline.pyramid_pupils import find_pupils, refine_pupils
from escape_hw.pipeline.pyramid_slopes import PyramidSlopes
from escape_hw.pipeline.slopes import SlopeExtractor

#: A geometry's modulation and the one in force may differ by this share.
_SAME_MODULATION = 0.01


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

    sought: str
    source_references: str
    long_look: bool

    def prepare(self, bench: Bench) -> None:
        """Make the sensor ready for frames that mean something."""
        ...

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Level of the pixels that no light reaches, in counts."""
        ...

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> SensorGeometry:
        """The geometry on a calibrated mean frame; ``references`` is ``"design"`` or ``"mean"``."""
        ...

    def refined(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> SensorGeometry:
        """The geometry, better known by calibrated mean frames of a run's parts; its slopes stay the same."""
        ...

    def extractor(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> SlopeFunction:
        """What turns this camera's frames into slopes."""
        ...


class _ShackHartmann:
    """Lenslets: spots on a lattice."""

    sought = "lenslet grid"
    # Lenslets stand regularly; what their spots lack of it is the aberration that a loop should take out.
    source_references = "design"
    long_look = False

    def __init__(self, section: ShackHartmannSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Nothing moves in a Shack-Hartmann sensor."""

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Median of the darkest fifth: between the spots and outside the pupil a frame is dark."""
        return _darkest(mean_frame)

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> SubApertureGrid:
        return find_grid(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_pitch_px=self._section.pitch_px,
            threshold=self._threshold(bench),
            min_flux=self._section.min_flux,
            references="lattice" if references == "design" else references,
        )

    def refined(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> SensorGeometry:
        """As it is: the mean slopes of the run already tell all that its mean frame does."""
        return grid

    def extractor(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> SlopeExtractor:
        lenslets = of_kind(grid, SubApertureGrid)
        centres, half = lenslets.centres_px(), lenslets.pitch_px / 2
        if (centres < half - 1).any() or (centres > np.array(shape[::-1]) - half).any():
            raise IncompatibleProduct(_beyond("lenslet grid reaches", shape))
        return SlopeExtractor(lenslets, shape, dark=dark, flat=bench.flat, threshold=self._threshold(bench))

    def _threshold(self, bench: Bench) -> float:
        """Centre-of-gravity threshold in counts above the background."""
        return self._section.threshold * bench.wfs.info.full_scale


class _Pyramid:
    """A pyramid: four pupil images, and a modulator that has to turn."""

    sought = "pupil images"
    # A pyramid has no lattice to go by; on a source, what the sensor shows is the flat wavefront.
    source_references = "mean"
    long_look = True

    def __init__(self, section: PyramidSection) -> None:
        self._section = section

    def prepare(self, bench: Bench) -> None:
        """Modulate as configured, unless that is what the modulator does already."""
        modulator, asked = bench.modulator, bench.config.devices.modulator
        if modulator is None or asked is None:
            return
        if not self._section.modulation:
            modulator.park()
            return
        radius = self._section.modulation * asked.rad_per_lambda_d
        want = modulator.check(Modulation(radius, asked.frequency_hz))
        if modulator.modulation != want:
            modulator.modulate(want)

    def background(self, mean_frame: NDArray[np.float32]) -> float:
        """Median of the darkest fifth: the corners between and beside the images."""
        return _darkest(mean_frame)

    def find(self, bench: Bench, mean_frame: NDArray[np.float32], references: str) -> PyramidPupils:
        return find_pupils(
            mean_frame,
            n_sub=self._section.n_sub,
            nominal_px=np.array(self._section.pupils_px),
            min_flux=self._section.min_flux,
            normalisation=self._section.normalisation,
            modulation=modulation_in_force(bench),
            references=references,
        )

    def refined(
        self, bench: Bench, grid: SensorGeometry, means: Sequence[NDArray[np.float32]]
    ) -> PyramidPupils:
        """Rims and shadow on the mean of the whole run: turbulence averages out."""
        shadow = shadow_of(bench.config.telescope, bench.config.system.pupil_m)
        return refine_pupils(means, of_kind(grid, PyramidPupils), shadow)

    def extractor(
        self, bench: Bench, grid: SensorGeometry, shape: tuple[int, int], dark: NDArray[np.float32]
    ) -> PyramidSlopes:
        pupils = of_kind(grid, PyramidPupils)
        corners, n = pupils.corners_px, pupils.valid.shape[0]
        if (corners < 0).any() or (corners + n > np.array(shape[::-1])).any():
            raise IncompatibleProduct(_beyond("pupil images reach", shape))
        now = modulation_in_force(bench)
        if abs(now - pupils.modulation) > _SAME_MODULATION * max(now, pupils.modulation):
            raise IncompatibleProduct(
                f"the pupil images were measured with a modulation of {pupils.modulation:.4g} lambda/D, "
                f"the modulator does {now:.4g}; measure again, or set sensor.modulation"
            )
        return PyramidSlopes(pupils, shape, dark=dark, flat=bench.flat)


def modulation_in_force(bench: Bench) -> float:
    """Radius of the modulation as the modulator reports it, in lambda/D; 0 when it is parked."""
    section = bench.config.devices.modulator
    now = None if bench.modulator is None else bench.modulator.modulation
    return 0.0 if now is None or section is None else now.radius_rad / section.rad_per_lambda_d


def kind_of(bench: Bench) -> SensorKind:
    """The kind of sensor of a bench."""
    section = bench.config.sensor
    return _Pyramid(section) if isinstance(section, PyramidSection) else _ShackHartmann(section)


def _darkest(mean_frame: NDArray[np.float32]) -> float:
    """Median of the darkest fifth of the pixels, which leaves out the wings of what is bright."""
    darkest = np.sort(mean_frame.ravel())[: max(1, mean_frame.size // 5)]
    return float(np.median(darkest))


def _beyond(what: str, shape: tuple[int, int]) -> str:
    return (
        f"the {what} beyond the camera's region of {shape[1]} x {shape[0]} pixels; "
        "it was found on another region, so measure again"
    )
