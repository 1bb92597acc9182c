"""A calibration and a loop's telemetry in the AOT standard (Gomes et al. 2024), through ``aotpy``."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.errors import IncompatibleProduct
from escape_hw.io import fits_file
from escape_hw.io.documents import registration_document
from escape_hw.io.interchange import aot_geometry
from escape_hw.io.interchange.optional import library
from escape_hw.io.storage import make_folder, storage_error, write_atomic
from escape_hw.io.telemetry import LoopTelemetry

#: Names of the parts in the file.
SENSOR, MIRROR, LOOP, ERRORS, STAR = "WFS", "DM", "LOOP", "STANDARD ERRORS", "LIGHT"


@dataclass(frozen=True, slots=True)
class AotFacts:
    """What the standard wants to know of the system besides its calibration.

    Parameters
    ----------
    pupil_m
        Diameter of the pupil, metres.
    wavelength_m
        Of the sensor, metres.
    stroke_m
        Metres of surface for a command of 1.
    positions_m
        Actuators ``(n_act, 2)`` as (x, y) on the mirror, metres.
    frame_rate_hz
        Of the sensor's camera.
    """

    pupil_m: float
    wavelength_m: float
    stroke_m: float
    positions_m: tuple[tuple[float, float], ...]
    frame_rate_hz: float


def write_aot(
    path: Path,
    result: CalibrationResult,
    facts: AotFacts,
    telemetry: LoopTelemetry | None = None,
    config_text: str = "",
) -> Path:
    """Write one AOT file.

    Measurements and commands are the telemetry's, where there is any; commands and modes are converted to
    metres of surface, as the standard has it. The matrix stands as ``modes_to_measurements``, its standard
    errors as that of a second loop of the same parts.

    Parameters
    ----------
    path
        A name that ends in ``.fits``.
    result
        The calibration.
    facts
        Of the system.
    telemetry
        Of a loop on the same sensor geometry.
    config_text
        The whole configuration.

    Raises
    ------
    ConfigError
        ``aotpy`` is not installed.
    IncompatibleProduct
        The telemetry has other slopes or actuators than the matrix.
    StorageError
        The file cannot be written.
    """
    aotpy = library("aotpy", "Writing AOT files")
    matrix = result.matrix
    if telemetry is not None:
        wanted, found = (matrix.n_slopes, matrix.m2c.shape[0]), (
            telemetry.slopes.shape[1], telemetry.commands.shape[1],
        )  # fmt: skip
        if wanted != found:
            raise IncompatibleProduct(
                f"the telemetry has {found[0]} slopes and {found[1]} actuators, the matrix {wanted[0]} and "
                f"{wanted[1]}; they belong to different calibrations"
            )
    system = _Writer(aotpy, result, facts, telemetry).system()
    # A header card holds no line breaks.
    system.config = fits_file.plain(config_text)
    make_folder(path.parent)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".aot.") as folder:
            made = Path(folder) / "aot.fits"
            system.write_to_file(made)
            content = made.read_bytes()
    except OSError as error:
        raise storage_error(path, error) from error
    write_atomic(path, content)
    return path


class _Writer:
    """Puts the parts together."""

    def __init__(
        self, aotpy: Any, result: CalibrationResult, facts: AotFacts, telemetry: LoopTelemetry | None
    ) -> None:
        self.aotpy, self.result, self.facts, self.telemetry = aotpy, result, facts, telemetry

    def image(
        self, name: str, data: Any, unit: str | None = None, facts: Mapping[str, Any] | None = None
    ) -> Any:
        """Data with a name that must be its own, and metadata by keyword."""
        metadata = [self.aotpy.Metadatum(key, value) for key, value in (facts or {}).items()]
        return self.aotpy.Image(name, np.ascontiguousarray(data), unit, metadata=metadata)

    def system(self) -> Any:
        """The whole system."""
        a, matrix = self.aotpy, self.result.matrix
        telescope = a.MainTelescope(uid="PUPIL", enclosing_diameter=self.facts.pupil_m)
        star = a.NaturalGuideStar(uid=STAR)
        sensor = self.sensor(star)
        mirror = a.DeformableMirror(
            uid=MIRROR,
            telescope=telescope,
            n_valid_actuators=matrix.m2c.shape[0],
            actuator_coordinates=[a.Coordinates(x, y) for x, y in self.facts.positions_m],
            stroke=self.facts.stroke_m,
        )
        return a.AOSystem(
            ao_mode="SCAO",
            name=matrix.system,
            main_telescope=telescope,
            sources=[star],
            wavefront_sensors=[sensor],
            wavefront_correctors=[mirror],
            loops=self.loops(sensor, mirror),
            metadata=[a.Metadatum(key, value) for key, value in self.words().items()],
        )

    def words(self) -> dict[str, Any]:
        """Scalars of the calibration, by FITS keyword."""
        matrix, found = self.result.matrix, registration_document(self.result.registration)
        words: dict[str, Any] = {
            "METHOD": matrix.method,
            "SIMULATE": bool(matrix.simulated),
            "FRAMES": int(self.result.frames),
            "LOST": int(self.result.lost_frames),
            "SKYSEC": float(self.result.sky_seconds),
            "SLOPUNIT": matrix.slope_unit,
            "SENSOR": self.result.grid.kind,
        }
        for number, (name, value) in enumerate((found["registration"] or {}).items(), 1):
            words |= {
                f"REGNAM{number}": name,
                f"REGVAL{number}": value["value"],
                f"REGERR{number}": value["sigma"],
            }
        return words

    def sensor(self, star: Any) -> Any:
        """The wavefront sensor, with its measurements."""
        a, grid = self.aotpy, self.result.grid
        references = np.asarray(getattr(grid, "references_px", getattr(grid, "references", None)), np.float32)
        unit = "pix" if self.result.matrix.slope_unit == "pixel" else None
        common = {
            "uid": SENSOR,
            "source": star,
            "n_valid_subapertures": grid.n_valid,
            "ref_measurements": self.image("REFERENCES", references.T, unit),
            "subaperture_mask": self.image(
                "SUBAPERTURES", aot_geometry.numbered(grid.valid), facts=aot_geometry.facts_of(grid)
            ),
            "mask_offsets": [a.Coordinates(x, y) for x, y in aot_geometry.corners_of(grid)],
            "subaperture_size": aot_geometry.size_of(grid),
            "subaperture_intensities": self.image("FLUX", grid.flux[grid.valid][None].astype(np.float32)),
            "wavelength": self.facts.wavelength_m,
            "detector": a.Detector(uid="WFS CAMERA", frame_rate=self.facts.frame_rate_hz),
        }
        if self.telemetry is not None:
            slopes = self.telemetry.slopes.reshape(len(self.telemetry.slopes), 2, -1)
            common["measurements"] = self.image("SLOPES", slopes, unit)
            common["measurements"].time = self.time()
        if isinstance(grid, PyramidPupils):
            return a.Pyramid(n_sides=4, dimensions=2, **common)
        return a.ShackHartmann(centroiding_algorithm="thresholded centre of gravity", **common)

    def loops(self, sensor: Any, mirror: Any) -> list[Any]:
        """The loop with the matrix, and the one that holds its standard errors."""
        a, matrix, response = self.aotpy, self.result.matrix, self.result.response
        modes = self.image("MODES", matrix.m2c * self.facts.stroke_m, "m")
        loop = a.ControlLoop(
            uid=LOOP,
            commanded_corrector=mirror,
            input_sensor=sensor,
            closed=self.telemetry is not None,
            framerate=self.facts.frame_rate_hz,
            delay=None if response is None else float(response.delay),
            modes_to_commands=modes,
            modes_to_measurements=self.image("MATRIX", _cube(matrix.data), matrix.slope_unit),
        )
        if self.telemetry is not None:
            loop.time = self.time()
            commands = self.telemetry.commands * self.facts.stroke_m
            loop.commands = self.image("COMMANDS", commands, "m")
            loop.commands.time = loop.time
        errors = a.ControlLoop(
            uid=ERRORS,
            commanded_corrector=mirror,
            input_sensor=sensor,
            closed=False,
            modes_to_commands=modes,
            modes_to_measurements=self.image("MATRIX ERRORS", _cube(matrix.sigma), matrix.slope_unit),
        )
        return [loop, errors]

    def time(self) -> Any:
        """Times and numbers of the frames; the same object for all that share them."""
        record = self.telemetry
        if record is not None and not hasattr(self, "_time"):
            self._time = self.aotpy.Time(
                uid="FRAMES",
                timestamps=record.exposed_s.tolist(),
                frame_numbers=record.index.tolist(),
            )
        return getattr(self, "_time", None)


def _cube(rows: Any) -> Any:
    """Rows (all x, then all y) as the standard has them: ``(n_valid, 2, n_modes)``."""
    return np.asarray(rows, np.float32).reshape(2, -1, rows.shape[1]).transpose(1, 0, 2)
