"""Calibrations and loop telemetry in the AOT standard (Gomes et al. 2024), through ``aotpy``."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.documents import registration_document
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.extensions import geometry_cards, geometry_fields, reference_slopes
from escape_hw.io.fits.telemetry import LoopTelemetry
from escape_hw.io.interchange.optional_packages import import_optional
from escape_hw.io.storage import make_folder, storage_error, write_atomic


def _mask_corners(geometry: SensorGeometry) -> list[tuple[float, float]]:
    """Lowest (x, y) that each mask occupies on the detector, pixels from its first pixel's edge."""
    if isinstance(geometry, PyramidPupils):
        return [(float(x), float(y)) for x, y in geometry.corners_px]
    grid = require_kind(geometry, SubApertureGrid)
    return [(grid.origin_px[0] - (grid.pitch_px - 1) / 2, grid.origin_px[1] - (grid.pitch_px - 1) / 2)]


def _mask_metadata(geometry: SensorGeometry) -> dict[str, float | str]:
    """What the standard has no place for, by keyword."""
    metadata = geometry_cards(geometry)
    if isinstance(geometry, PyramidPupils):
        for k, (x, y) in enumerate(geometry.centres_px):
            metadata |= {f"CENTREX{k}": float(x), f"CENTREY{k}": float(y)}
    return metadata


def _build_lenslet_grid(
    parts: dict[str, Any], corners: list[tuple[float, float]], size: float, metadata: dict[str, Any]
) -> SubApertureGrid:
    """A lenslet grid from the standard's parts; ``metadata`` of the mask is written by ESCAPE only."""
    x, y = corners[0] if corners else (0.0, 0.0)
    half = (size - 1) / 2
    origin = (float(metadata.get("ORIGINX", x + half)), float(metadata.get("ORIGINY", y + half)))
    fields = geometry_fields(SubApertureGrid.kind, metadata) | {"pitch_px": size}
    fields |= {"valid": parts["valid"], "references_px": parts["references"], "flux": parts["flux"]}
    return SubApertureGrid(origin_px=origin, **fields)


def _build_pyramid_pupils(
    parts: dict[str, Any], corners: list[tuple[float, float]], metadata: dict[str, Any]
) -> PyramidPupils:
    """The images of a pyramid from the standard's parts; see :func:`_build_lenslet_grid`."""
    if len(corners) != 4:
        raise IncompatibleProduct(f"the pyramid has {len(corners)} masks on its detector; ours has four")
    at = np.array(corners, float)
    n = parts["valid"].shape[0]
    centres = at + (n - 1) / 2
    for k in range(4):
        centres[k] = (metadata.get(f"CENTREX{k}", centres[k, 0]), metadata.get(f"CENTREY{k}", centres[k, 1]))
    fields = geometry_fields(PyramidPupils.kind, metadata)
    fields["diameter_px"] = fields.get("diameter_px") or float(n)
    return PyramidPupils(centres_px=centres, corners_px=np.round(at).astype(np.intp), **parts, **fields)


#: Names of the parts in the file.
SENSOR, MIRROR, LOOP, ERRORS, SOURCE = "WFS", "DM", "LOOP", "STANDARD ERRORS", "LIGHT"


@dataclass(frozen=True, slots=True)
class AotSystem:
    """Properties of the system that AOT stores besides its calibration.

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
    facts: AotSystem,
    telemetry: LoopTelemetry | None = None,
    config_text: str = "",
) -> Path:
    """Write one AOT file.

    Measurements and commands are the telemetry's, where there is any; commands and modes are converted to
    metres of surface, as AOT defines it. The matrix is stored as ``modes_to_measurements``, its standard
    errors as that of a second loop of the same parts.

    Parameters
    ----------
    path
        A name that ends in ``.fits``.
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
    aotpy = import_optional("aotpy", "Writing AOT files")
    matrix = result.matrix
    if telemetry is not None:
        wanted = (matrix.n_slopes, matrix.m2c.shape[0])
        found = (telemetry.slopes.shape[1], telemetry.commands.shape[1])
        if wanted != found:
            raise IncompatibleProduct(
                f"the telemetry has {found[0]} slopes and {found[1]} actuators, the matrix {wanted[0]} and "
                f"{wanted[1]}; they belong to different calibrations"
            )
    system = _AotWriter(aotpy, result, facts, telemetry).system()
    # A header card holds no line breaks.
    system.config = fits_file.header_text(config_text)
    make_folder(path.parent)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".aot.") as folder:
            temporary = Path(folder) / "system.fits"
            system.write_to_file(temporary)
            content = temporary.read_bytes()
    except OSError as error:
        raise storage_error(path, error) from error
    write_atomic(path, content)
    return path


class _AotWriter:
    """Puts the parts together."""

    def __init__(
        self, aotpy: Any, result: CalibrationResult, facts: AotSystem, telemetry: LoopTelemetry | None
    ) -> None:
        self.aotpy, self.result, self.facts, self.telemetry = aotpy, result, facts, telemetry
        if telemetry is not None:
            # The same object for all parts that share it.
            self.time = aotpy.Time(
                uid="FRAMES", timestamps=telemetry.exposed_s.tolist(), frame_numbers=telemetry.index.tolist()
            )

    def image(
        self, name: str, data: Any, unit: str | None = None, metadata: Mapping[str, Any] | None = None
    ) -> Any:
        """Data with a unique name, and metadata by keyword."""
        items = [self.aotpy.Metadatum(key, value) for key, value in (metadata or {}).items()]
        return self.aotpy.Image(name, np.ascontiguousarray(data), unit, metadata=items)

    def system(self) -> Any:
        """The whole system."""
        a, matrix = self.aotpy, self.result.matrix
        telescope = a.MainTelescope(uid="PUPIL", enclosing_diameter=self.facts.pupil_m)
        star = a.NaturalGuideStar(uid=SOURCE)
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
            metadata=[a.Metadatum(key, value) for key, value in self.keywords().items()],
        )

    def keywords(self) -> dict[str, Any]:
        """Scalars of the calibration, by FITS keyword."""
        matrix, found = self.result.matrix, registration_document(self.result.registration)
        keywords: dict[str, Any] = {
            "METHOD": matrix.method,
            "SIMULATE": bool(matrix.simulated),
            "FRAMES": int(self.result.frames),
            "LOST": int(self.result.lost_frames),
            "SKYSEC": float(self.result.sky_seconds),
            "SLOPUNIT": matrix.slope_unit,
            "SENSOR": self.result.grid.kind,
        }
        for number, (name, value) in enumerate((found["registration"] or {}).items(), 1):
            keywords |= {
                f"REGNAM{number}": name,
                f"REGVAL{number}": value["value"],
                f"REGERR{number}": value["sigma"],
            }
        return keywords

    def sensor(self, star: Any) -> Any:
        """The wavefront sensor, with its measurements."""
        a, grid = self.aotpy, self.result.grid
        # The mask in AOT form: the number of each valid sub-aperture, -1 elsewhere.
        mask = np.full(grid.valid.shape, -1, np.int32)
        mask[grid.valid] = np.arange(grid.n_valid)
        unit = "pix" if self.result.matrix.slope_unit == "pixel" else None
        common = {
            "uid": SENSOR,
            "source": star,
            "n_valid_subapertures": grid.n_valid,
            "ref_measurements": self.image("REFERENCES", reference_slopes(grid).T, unit),
            "subaperture_mask": self.image("SUBAPERTURES", mask, metadata=_mask_metadata(grid)),
            "mask_offsets": [a.Coordinates(x, y) for x, y in _mask_corners(grid)],
            "subaperture_size": float(grid.pitch_px) if isinstance(grid, SubApertureGrid) else 1.0,
            "subaperture_intensities": self.image("FLUX", grid.flux[grid.valid][None].astype(np.float32)),
            "wavelength": self.facts.wavelength_m,
            "detector": a.Detector(uid="WFS CAMERA", frame_rate=self.facts.frame_rate_hz),
        }
        if self.telemetry is not None:
            slopes = self.telemetry.slopes.reshape(len(self.telemetry.slopes), 2, -1)
            common["measurements"] = self.image("SLOPES", slopes, unit)
            common["measurements"].time = self.time
        if isinstance(grid, PyramidPupils):
            return a.Pyramid(n_sides=4, dimensions=2, **common)
        return a.ShackHartmann(centroiding_algorithm="thresholded centre of gravity", **common)

    def loops(self, sensor: Any, mirror: Any) -> list[Any]:
        """The loop with the matrix, and the one that holds its standard errors."""
        a, matrix, response = self.aotpy, self.result.matrix, self.result.response
        shared = {
            "commanded_corrector": mirror,
            "input_sensor": sensor,
            "modes_to_commands": self.image("MODES", matrix.m2c * self.facts.stroke_m, "m"),
        }
        loop = a.ControlLoop(
            uid=LOOP,
            closed=self.telemetry is not None,
            framerate=self.facts.frame_rate_hz,
            delay=None if response is None else float(response.delay_frames),
            modes_to_measurements=self.image("MATRIX", _to_cube(matrix.data), matrix.slope_unit),
            **shared,
        )
        if self.telemetry is not None:
            loop.time = self.time
            commands = self.telemetry.commands * self.facts.stroke_m
            loop.commands = self.image("COMMANDS", commands, "m")
            loop.commands.time = loop.time
        sigma = self.image("MATRIX ERRORS", _to_cube(matrix.sigma), matrix.slope_unit)
        errors = a.ControlLoop(uid=ERRORS, closed=False, modes_to_measurements=sigma, **shared)
        return [loop, errors]


def _to_cube(rows: Any) -> Any:
    """Rows (all x, then all y) as the standard has them: ``(n_valid, 2, n_modes)``."""
    return np.asarray(rows, np.float32).reshape(2, -1, rows.shape[1]).transpose(1, 0, 2)


@dataclass(frozen=True, slots=True, eq=False)
class AotContent:
    """Contents of an AOT file for one loop.

    ``calibration`` is the matrix with its modes, ``telemetry`` slopes and commands, where the file has them.
    """

    system: str
    geometry: SensorGeometry
    calibration: CalibrationResult | None
    telemetry: LoopTelemetry | None
    config_text: str


def read_aot(path: Path | str, stroke_m: float | None = None, loop: str = "") -> AotContent:
    """Read the loop of an AOT file that has a sensor.

    Parameters
    ----------
    stroke_m
        Metres of surface for a command of 1; the file's own by default.
    loop
        Name of the loop, where there are several.

    Raises
    ------
    ConfigError
        ``aotpy`` is not installed.
    ProductError
        Not there or damaged.
    IncompatibleProduct
        It has no such loop, or a sensor that we have no geometry for.
    """
    aotpy = import_optional("aotpy", "Reading AOT files")
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            system = aotpy.AOSystem.read_from_file(path)
    except FileNotFoundError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:
        raise ProductError(
            f"{path}: not an AOT file that aotpy reads ({type(error).__name__}: {error})"
        ) from error
    selected = _select_loop(path, aotpy, system, loop)
    return _AotReader(path, aotpy, system, selected, stroke_m).read_content()


def _select_loop(path: Path, aotpy: Any, system: Any, name: str) -> Any:
    loops = [one for one in system.loops if isinstance(one, aotpy.ControlLoop) and one.uid != ERRORS]
    selected = [one for one in loops if not name or one.uid == name]
    if len(selected) != 1:
        known = ", ".join(one.uid for one in loops) or "none"
        raise IncompatibleProduct(f"{path}: which loop? It has: {known}; name one with --loop")
    return selected[0]


class _AotReader:
    """Takes the parts apart."""

    def __init__(self, path: Path, aotpy: Any, system: Any, loop: Any, stroke_m: float | None) -> None:
        self.path, self.aotpy, self.system, self.loop = path, aotpy, system, loop
        self.sensor, self.mirror = loop.input_sensor, loop.commanded_corrector
        self.keywords = {one.key: one.value for one in system.metadata}
        self.stroke_m = stroke_m or getattr(self.mirror, "stroke", None)
        if self.sensor.subaperture_mask is None:
            raise self._incompatible("its sensor has no mask of sub-apertures")
        numbers = np.asarray(self.sensor.subaperture_mask.data)
        self.valid = numbers >= 0
        # The numbers of the sub-apertures row by row, which is our order.
        self.order = numbers[self.valid].astype(np.intp)

    def read_content(self) -> AotContent:
        """Everything."""
        geometry = self._geometry()
        text = str(self.system.config or "").encode("ascii", "replace").decode("unicode_escape")
        return AotContent(
            str(self.system.name or ""), geometry, self._calibration(geometry), self._telemetry(), text
        )

    def _incompatible(self, what: str) -> IncompatibleProduct:
        return IncompatibleProduct(f"{self.path}: {what}")

    def _require_stroke(self) -> float:
        if not self.stroke_m:
            raise self._incompatible(
                "its mirror states no stroke, so commands in metres mean nothing; give --stroke"
            )
        return float(self.stroke_m)

    def _geometry(self) -> SensorGeometry:
        sensor, n = self.sensor, int(self.valid.sum())
        if sensor.dimensions != 2:
            raise self._incompatible(
                f"its sensor measures {sensor.dimensions} values per sub-aperture; ours two"
            )
        references = np.zeros((n, 2), np.float32)
        if sensor.ref_measurements is not None:
            references = np.asarray(sensor.ref_measurements.data, np.float32).T[self.order]
        flux = self.valid.astype(np.float32)
        if sensor.subaperture_intensities is not None:
            light = np.asarray(sensor.subaperture_intensities.data, float).reshape(-1, n).mean(axis=0)
            flux[self.valid] = light[self.order] / max(float(light.max()), 1e-30)
        metadata = {one.key: one.value for one in sensor.subaperture_mask.metadata}
        corners = [(float(at.x or 0), float(at.y or 0)) for at in sensor.mask_offsets]
        parts = {"valid": self.valid, "references": references, "flux": flux}
        if isinstance(sensor, self.aotpy.Pyramid):
            return _build_pyramid_pupils(parts, corners, metadata)
        return _build_lenslet_grid(parts, corners, float(sensor.subaperture_size or 1.0), metadata)

    def _rows(self, cube: NDArray[Any]) -> NDArray[np.float32]:
        """``(n_valid, 2, n_modes)`` of the standard as our rows."""
        return np.ascontiguousarray(
            np.asarray(cube, np.float32)[self.order].transpose(1, 0, 2).reshape(-1, cube.shape[2])
        )

    def _calibration(self, geometry: SensorGeometry) -> CalibrationResult | None:
        loop = self.loop
        if loop.modes_to_measurements is not None and loop.modes_to_commands is not None:
            data = self._rows(loop.modes_to_measurements.data)
            modes = np.asarray(loop.modes_to_commands.data, float)
            m2c = modes / self._require_stroke() if loop.modes_to_commands.unit == "m" else modes
        elif loop.interaction_matrix is not None:
            data = self._rows(loop.interaction_matrix.data)
            m2c = np.eye(data.shape[1])
        else:
            return None
        matrix = InteractionMatrix(
            data, self._errors(data), m2c, self.valid, str(self.system.name or ""),
            str(self.keywords.get("METHOD", "aot")), bool(self.keywords.get("SIMULATE", False)), {},
            geometry.slope_unit,
        )  # fmt: skip
        notes = (f"read from {self.path.name}",)
        return CalibrationResult(
            matrix, geometry, int(self.keywords.get("FRAMES", 0)), int(self.keywords.get("LOST", 0)),
            float(self.keywords.get("SKYSEC", 0.0)), notes=notes,
        )  # fmt: skip

    def _errors(self, data: NDArray[np.float32]) -> NDArray[np.float32]:
        """The standard errors that we wrote; zeros, for unknown, where there are none."""
        for one in self.system.loops:
            if one.uid == ERRORS and one.modes_to_measurements is not None:
                return self._rows(one.modes_to_measurements.data)
        return np.zeros_like(data)

    def _telemetry(self) -> LoopTelemetry | None:
        slopes, commands = self.sensor.measurements, self.loop.commands
        if slopes is None or commands is None:
            return None
        rows = np.asarray(slopes.data, np.float32)[:, :, self.order].reshape(len(slopes.data), -1)
        command_rows = np.asarray(commands.data, float)
        if len(rows) != len(command_rows):
            raise self._incompatible(
                f"it has {len(rows)} measurements and {len(command_rows)} commands; only as many of one as "
                "of the other can be put in pairs"
            )
        frame_times = commands.time or self.loop.time or slopes.time
        index = np.asarray(getattr(frame_times, "frame_numbers", None) or np.arange(len(rows))).astype(
            np.int64
        )
        exposed = np.asarray(getattr(frame_times, "timestamps", None) or np.zeros(len(rows)), float)
        return LoopTelemetry(index, exposed - exposed[:1], rows, command_rows / self._require_stroke())
