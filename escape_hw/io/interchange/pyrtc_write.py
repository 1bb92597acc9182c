"""An interaction matrix of ours as the files and settings that pyRTC closes a loop with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, of_kind
from escape_hw.errors import IncompatibleProduct
from escape_hw.io.documents import registration_document
from escape_hw.io.interchange.pyrtc_file import MATRIX, REFERENCES, VALID, write_array, write_file
from escape_hw.io.interchange.pyrtc_lenslets import PyrtcLenslets
from escape_hw.io.interchange.pyrtc_pupils import PyrtcPupils
from escape_hw.io.storage import write_atomic

SETTINGS = "pyrtc.yaml"
_FILES = {"im": "im.npz", "valid": "valid_sub_aps.npz", "references": "ref_slopes.npz", "m2c": "m2c.npy"}
#: Largest part of a wanted mode, relative to it, that a matrix may fail to span.
_OUTSIDE = 1e-6


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """What pyRTC needs to know of the camera besides the geometry.

    Parameters
    ----------
    shape
        Frame (rows, columns).
    threshold
        Counts below which a pixel of a spot counts as dark.
    """

    shape: tuple[int, int]
    threshold: float


def in_basis(matrix: InteractionMatrix, m2c: NDArray[np.float64]) -> InteractionMatrix:
    """The same matrix for other modes, which lie in the span of its own.

    Parameters
    ----------
    matrix
        ``D`` for the modes ``M``.
    m2c
        Wanted modes ``M' (n_act, n)``: the result is ``D M^+ M'``.

    Raises
    ------
    IncompatibleProduct
        A wanted mode is no sum of the matrix's own.
    """
    if m2c.shape[0] != matrix.m2c.shape[0]:
        raise IncompatibleProduct(
            f"the wanted modes move {m2c.shape[0]} actuators, the matrix {matrix.m2c.shape[0]}"
        )
    turn = np.linalg.lstsq(matrix.m2c, m2c, rcond=None)[0]
    outside = np.linalg.norm(matrix.m2c @ turn - m2c, axis=0) / np.linalg.norm(m2c, axis=0)
    if outside.max(initial=0.0) > _OUTSIDE:
        raise IncompatibleProduct(
            f"mode {int(outside.argmax())} of those wanted is no sum of the matrix's {matrix.n_modes} modes "
            f"({outside.max():.2g} of it is left over); calibrate with basis.n_modes={m2c.shape[0]}, or take "
            "the matrix's own modes"
        )
    data = (matrix.data.astype(float) @ turn).astype(np.float32)
    variance = np.square(matrix.sigma.astype(float)) @ np.square(turn)
    return InteractionMatrix(
        data, np.sqrt(variance).astype(np.float32), m2c, matrix.valid, matrix.system, matrix.method,
        matrix.simulated, dict(matrix.metrics), matrix.slope_unit,
    )  # fmt: skip


def export_matrix(
    folder: Path, result: CalibrationResult, facts: FrameFacts, m2c: NDArray[np.float64] | None = None
) -> dict[str, Path]:
    """Write matrix, mask, references, modes and the settings that go with them.

    Parameters
    ----------
    folder
        Where; files of these names are replaced.
    result
        The calibration.
    facts
        The camera's.
    m2c
        Modes that pyRTC's commands are to mean ``(n_act, n_modes)``; the matrix's own by default.

    Returns
    -------
    dict
        Paths by name: ``im``, ``valid``, ``references``, ``m2c``, ``settings``.

    Raises
    ------
    IncompatibleProduct
        pyRTC cannot read a sensor like this, or the modes are not the matrix's.
    StorageError
        A file cannot be written.
    """
    matrix = result.matrix if m2c is None else in_basis(result.matrix, m2c)
    slopes, mask, references, (data, sigma) = _sensor(result.grid, facts, matrix)
    paths = {name: folder / file for name, file in _FILES.items()}
    kind = {"wfs_type": "pywfs" if isinstance(result.grid, PyramidPupils) else "shwfs"}
    write_file(paths["im"], data, MATRIX, _record(result, matrix), {"sigma": sigma})
    write_file(paths["valid"], mask, VALID, kind)
    write_file(paths["references"], references, REFERENCES, kind)
    write_array(paths["m2c"], matrix.m2c)
    sections = {
        "slopes": slopes,
        "wfc": {"num_actuators": matrix.m2c.shape[0], "num_modes": matrix.n_modes, "m2c_file": _FILES["m2c"]},
        "loop": {"im_file": _FILES["im"]},
    }
    paths["settings"] = folder / SETTINGS
    write_atomic(paths["settings"], _yaml(sections).encode())
    return paths


def _sensor(
    grid: SensorGeometry, facts: FrameFacts, matrix: InteractionMatrix
) -> tuple[dict[str, Any], NDArray[np.bool_], NDArray[np.float32], tuple[NDArray[np.float32], ...]]:
    """The slopes section, mask, references, and matrix and errors row by row as pyRTC has them."""
    both = (matrix.data, matrix.sigma)
    if isinstance(grid, PyramidPupils):
        images = PyrtcPupils.of(grid)
        section = {
            "type": "PYWFS",
            "signal_type": "slopes",
            "pupils": [f"{x},{y}" for x, y in images.centres],
            "pupils_radius": images.radius,
            "ref_slopes_file": _FILES["references"],
        }
        rows = tuple(images.rows_of(grid, part) for part in both)
        return section, images.mask_of(), images.references_of(grid), rows
    lenslets = of_kind(grid, SubApertureGrid)
    windows = PyrtcLenslets.of(lenslets, facts.shape)
    section = {
        "type": "SHWFS",
        "signal_type": "slopes",
        "sub_ap_spacing": windows.spacing,
        "sub_ap_offset_x": windows.offset_x,
        "sub_ap_offset_y": windows.offset_y,
        # pyRTC's threshold is the product of these two.
        "image_noise": facts.threshold,
        "contrast": 1.0,
        "valid_sub_aps_file": _FILES["valid"],
        "ref_slopes_file": _FILES["references"],
    }
    return section, windows.mask_of(lenslets), windows.references_of(lenslets), both


def _record(result: CalibrationResult, matrix: InteractionMatrix) -> dict[str, Any]:
    """What a reader may want to know of the matrix."""
    return {
        "system": matrix.system,
        "method": matrix.method,
        "simulated": matrix.simulated,
        "slope_unit": matrix.slope_unit,
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "delay_frames": None if result.response is None else result.response.delay,
        **registration_document(result.registration),
    }


def _yaml(sections: dict[str, dict[str, Any]]) -> str:
    """Sections of plain values as YAML."""
    lines = ["# Written by ESCAPE: merge these keys into pyRTC's configuration, in this folder."]
    for name, values in sections.items():
        lines.append(f"{name}:")
        for key, value in values.items():
            if isinstance(value, list):
                lines += [f"  {key}:", *(f'  - "{item}"' for item in value)]
            else:
                lines.append(f"  {key}: {value}")
    return "\n".join(lines) + "\n"
