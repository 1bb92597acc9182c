"""Saves what a panel shows: its picture, its numbers as text, its arrays as FITS."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PySide6.QtCore import QBuffer, QIODevice
from PySide6.QtWidgets import QWidget

from escape_gui.panels.panel import Panel, Shown
from escape_hw.errors import EscapeError
from escape_hw.io.provenance import Provenance
from escape_hw.io.storage import write_atomic
from escape_hw.remote.state import State

#: Kind of the FITS files: what a screen showed, no calibration product.
KIND_SCREEN = "SCREEN"


def save_png(path: Path, widget: QWidget) -> tuple[Path, ...]:
    """Save a widget as it looks now.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    buffer = QBuffer()
    buffer.open(QIODevice.OpenModeFlag.WriteOnly)
    widget.grab().save(buffer, "PNG")
    write_atomic(path, bytes(buffer.data().data()))
    return (path,)


def save_csv(path: Path, panel: Panel) -> tuple[Path, ...]:
    """Save a panel's arrays as text, one file each when there are several.

    Raises
    ------
    EscapeError
        The panel shows no arrays now.
    StorageError
        A file cannot be written.
    """
    arrays = _arrays(panel)
    written = []
    for one in arrays:
        target = path if len(arrays) == 1 else path.with_name(f"{path.stem}_{one.name}{path.suffix}")
        write_atomic(target, _csv(one).encode())
        written.append(target)
    return tuple(written)


def save_fits(path: Path, panel: Panel, state: State) -> tuple[Path, ...]:
    """Save a panel's arrays as extensions of one FITS file with checksums.

    Raises
    ------
    EscapeError
        The panel shows no arrays now.
    StorageError
        The file cannot be written.
    """
    from escape_hw.io import fits_file

    arrays = _arrays(panel)
    origin = Provenance(seed=state.seed if state.simulated else None)
    head = fits_file.primary(KIND_SCREEN, state.system, state.simulated, False, origin)
    head.header["PANEL"] = (panel.name, "panel that showed it")
    images = [fits_file.image(one.name.upper(), np.asarray(one.data), one.unit) for one in arrays]
    for hdu, one in zip(images, arrays, strict=True):
        for number, heading in enumerate(one.columns, 1):
            hdu.header[f"TTYPE{number}"] = fits_file.plain(heading)
    fits_file.write(path, [head, *images])
    return (path,)


def _arrays(panel: Panel) -> Sequence[Shown]:
    arrays = panel.shown()
    if not arrays:
        raise EscapeError(f"{panel.title} shows no numbers now; save its picture, or wait until it does")
    return arrays


def _csv(one: Shown) -> str:
    rows = np.atleast_2d(one.data) if one.data.ndim != 1 else np.asarray(one.data)[:, np.newaxis]
    unit = f" [{one.unit}]" if one.unit else ""
    headings = one.columns or tuple(
        f"{one.name}{unit}" if rows.shape[1] == 1 else str(k) for k in range(rows.shape[1])
    )
    text = io.StringIO()
    text.write(",".join(headings) + "\n")
    np.savetxt(text, rows, fmt="%.9g", delimiter=",")
    return text.getvalue()
