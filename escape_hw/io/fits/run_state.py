"""The state of a calibration that is still running, so that another process can go on with it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.sensor import SensorGeometry
from escape_hw.errors import ProductError
from escape_hw.io.fits import extensions as fits_geometry
from escape_hw.io.fits import file as fits_file
from escape_hw.io.provenance import Provenance

KIND_STATE = "STATE"
#: Name of the file in a run's folder.
STATE_FILE = "run.state"


@dataclass(frozen=True, slots=True, eq=False)
class RunState:
    """A run's state.

    Parameters
    ----------
    identity
        Settings of the run, which a resumed run must share. Plain JSON values.
    values
        Numbers and text of the state, plain JSON values.
    arrays
        Its arrays by name.
    grid
        The sensor's geometry, once it is known.
    """

    identity: Mapping[str, Any]
    values: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    grid: SensorGeometry | None = None


def save_state(path: Path, state: RunState, system: str, simulated: bool) -> None:
    """Write a state, whole or not at all; the one before it stays until then.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    # FITS images have at least one axis and one element; names and shapes are stored separately.
    non_empty = {name: array for name, array in state.arrays.items() if array.size}
    shapes = {name: [list(array.shape), array.dtype.str] for name, array in state.arrays.items()}
    book = {
        "identity": dict(state.identity),
        "values": dict(state.values),
        "shapes": shapes,
        "stored": list(non_empty),
    }
    hdus = [
        fits_file.primary_hdu(KIND_STATE, system, simulated, True, Provenance()),
        fits_file.text_extension("BOOK", json.dumps(book)),
        *(
            fits_file.image_extension(f"A{k}", np.atleast_1d(array))
            for k, array in enumerate(non_empty.values())
        ),
    ]
    if state.grid is not None:
        hdus += fits_geometry.pack_grid(state.grid)
    fits_file.write(path, hdus)


def load_state(path: Path) -> RunState:
    """Read a state.

    Raises
    ------
    ProductError
        Not there, truncated, damaged, or no state of a run.
    """
    hdus, _ = fits_file.read(path, KIND_STATE)
    try:
        book = json.loads(fits_file.read_text(path, hdus, "BOOK"))
        arrays = {name: np.zeros(shape, dtype) for name, (shape, dtype) in book["shapes"].items()}
        for k, name in enumerate(book["stored"]):
            shape, dtype = book["shapes"][name]
            arrays[name] = fits_file.read_array(path, hdus, f"A{k}", dtype).reshape(shape)
        grid = fits_geometry.unpack_grid(path, hdus) if "GRID" in hdus else None
        return RunState(book["identity"], book["values"], arrays, grid)
    except (KeyError, ValueError, TypeError) as error:
        raise ProductError(f"{path}: its parts do not fit together ({error})") from error
