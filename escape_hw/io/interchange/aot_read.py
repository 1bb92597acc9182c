"""Calibrations and telemetry read from AOT files, ours and other people's, through ``aotpy``."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.errors import IncompatibleProduct, ProductError
from escape_hw.io.interchange import aot_geometry
from escape_hw.io.interchange.aot_write import ERRORS
from escape_hw.io.interchange.optional import library
from escape_hw.io.telemetry import LoopTelemetry


@dataclass(frozen=True, slots=True, eq=False)
class AotContent:
    """What an AOT file says of one loop.

    Parameters
    ----------
    system
        Name of the system, as the file gives it.
    geometry
        Of the sensor.
    calibration
        The matrix with its modes, where the file has one.
    telemetry
        Slopes and commands, where it has both.
    config_text
        The configuration it carries.
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
    path
        The file.
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
    aotpy = library("aotpy", "Reading AOT files")
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            system = aotpy.AOSystem.read_from_file(path)
    except FileNotFoundError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:
        raise ProductError(
            f"{path}: not an AOT file that aotpy reads ({type(error).__name__}: {error})"
        ) from error
    chosen = _loop(path, aotpy, system, loop)
    return _Reader(path, aotpy, system, chosen, stroke_m).content()


def _loop(path: Path, aotpy: Any, system: Any, name: str) -> Any:
    loops = [one for one in system.loops if isinstance(one, aotpy.ControlLoop) and one.uid != ERRORS]
    chosen = [one for one in loops if not name or one.uid == name]
    if len(chosen) != 1:
        known = ", ".join(one.uid for one in loops) or "none"
        raise IncompatibleProduct(f"{path}: which loop? It has: {known}; name one with --loop")
    return chosen[0]


class _Reader:
    """Takes the parts apart."""

    def __init__(self, path: Path, aotpy: Any, system: Any, loop: Any, stroke_m: float | None) -> None:
        self.path, self.aotpy, self.system, self.loop = path, aotpy, system, loop
        self.sensor, self.mirror = loop.input_sensor, loop.commanded_corrector
        self.words = {one.key: one.value for one in system.metadata}
        self.stroke_m = stroke_m or getattr(self.mirror, "stroke", None)
        self.valid, self.order = self._mask()

    def content(self) -> AotContent:
        """Everything."""
        geometry = self._geometry()
        text = str(self.system.config or "").encode("ascii", "replace").decode("unicode_escape")
        return AotContent(
            str(self.system.name or ""), geometry, self._calibration(geometry), self._telemetry(), text
        )

    def _refuse(self, what: str) -> IncompatibleProduct:
        return IncompatibleProduct(f"{self.path}: {what}")

    def _stroke(self) -> float:
        if not self.stroke_m:
            raise self._refuse(
                "its mirror states no stroke, so commands in metres mean nothing; give --stroke"
            )
        return float(self.stroke_m)

    def _mask(self) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        image = self.sensor.subaperture_mask
        if image is None:
            raise self._refuse("its sensor has no mask of sub-apertures")
        return aot_geometry.order_of(image.data)

    def _geometry(self) -> SensorGeometry:
        sensor, n = self.sensor, int(self.valid.sum())
        if sensor.dimensions != 2:
            raise self._refuse(f"its sensor measures {sensor.dimensions} values per sub-aperture; ours two")
        references = np.zeros((n, 2), np.float32)
        if sensor.ref_measurements is not None:
            references = np.asarray(sensor.ref_measurements.data, np.float32).T[self.order]
        flux = self.valid.astype(np.float32)
        if sensor.subaperture_intensities is not None:
            light = np.asarray(sensor.subaperture_intensities.data, float).reshape(-1, n).mean(axis=0)
            flux[self.valid] = light[self.order] / max(float(light.max()), 1e-30)
        facts = {one.key: one.value for one in sensor.subaperture_mask.metadata}
        corners = [(float(at.x or 0), float(at.y or 0)) for at in sensor.mask_offsets]
        if isinstance(sensor, self.aotpy.Pyramid):
            return aot_geometry.pupils(self.valid, references, flux, corners, facts)
        size = float(sensor.subaperture_size or 1.0)
        return aot_geometry.lenslets(self.valid, references, flux, corners, size, facts)

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
            m2c = modes / self._stroke() if loop.modes_to_commands.unit == "m" else modes
        elif loop.interaction_matrix is not None:
            data = self._rows(loop.interaction_matrix.data)
            m2c = np.eye(data.shape[1])
        else:
            return None
        matrix = InteractionMatrix(
            data, self._errors(data), m2c, self.valid, str(self.system.name or ""),
            str(self.words.get("METHOD", "aot")), bool(self.words.get("SIMULATE", False)), {},
            geometry.slope_unit,
        )  # fmt: skip
        notes = (f"read from {self.path.name}",)
        return CalibrationResult(
            matrix, geometry, int(self.words.get("FRAMES", 0)), int(self.words.get("LOST", 0)),
            float(self.words.get("SKYSEC", 0.0)), notes=notes,
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
        moves = np.asarray(commands.data, float)
        if len(rows) != len(moves):
            raise self._refuse(
                f"it has {len(rows)} measurements and {len(moves)} commands; only as many of one as "
                "of the other can be put in pairs"
            )
        when = commands.time or self.loop.time or slopes.time
        index = np.asarray(getattr(when, "frame_numbers", None) or np.arange(len(rows))).astype(np.int64)
        exposed = np.asarray(getattr(when, "timestamps", None) or np.zeros(len(rows)), float)
        return LoopTelemetry(index, exposed - exposed[:1], rows, moves / self._stroke())
