"""Exports what a panel shows: image (PNG), table (CSV), arrays (FITS)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QBuffer, QIODevice
from PySide6.QtWidgets import QFileDialog, QWidget

from escape_gui.panels.base import ExportArray, Panel
from escape_gui.widgets.controls.status_indicator import Level
from escape_hw.errors import EscapeError
from escape_hw.io.provenance import Provenance
from escape_hw.io.storage import write_atomic
from escape_hw.remote.state import State

if TYPE_CHECKING:
    from escape_gui.main_window import MainWindow


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
    from escape_hw.io.fits import file as fits_file

    arrays = _arrays(panel)
    origin = Provenance(seed=state.seed if state.simulated else None)
    head = fits_file.primary_hdu(KIND_SCREEN, state.system, state.simulated, False, origin)
    head.header["PANEL"] = (panel.name, "panel that showed it")
    images = [fits_file.image_extension(one.name.upper(), np.asarray(one.data), one.unit) for one in arrays]
    for hdu, one in zip(images, arrays, strict=True):
        for number, heading in enumerate(one.columns, 1):
            hdu.header[f"TTYPE{number}"] = fits_file.header_text(heading)
    fits_file.write(path, [head, *images])
    return (path,)


def _arrays(panel: Panel) -> Sequence[ExportArray]:
    arrays = panel.export_arrays()
    if not arrays:
        raise EscapeError(f"{panel.title} shows no numbers now; save its picture, or wait until it does")
    return arrays


def _csv(one: ExportArray) -> str:
    rows = np.atleast_2d(one.data) if one.data.ndim != 1 else np.asarray(one.data)[:, np.newaxis]
    unit = f" [{one.unit}]" if one.unit else ""
    headings = one.columns or tuple(
        f"{one.name}{unit}" if rows.shape[1] == 1 else str(k) for k in range(rows.shape[1])
    )
    text = io.StringIO()
    text.write(",".join(headings) + "\n")
    np.savetxt(text, rows, fmt="%.9g", delimiter=",")
    return text.getvalue()


class Exporter:
    """Saves panels, and the window.

    Parameters
    ----------
    window
        Whose panels.
    """

    def __init__(self, window: MainWindow) -> None:
        self._window = window

    def panel(self, kind: str, panel: Panel | None = None) -> None:
        """Ask where, then save a panel as ``png``, ``csv`` or ``fits``; the one in focus by default."""
        panel = panel or self._window.focused_panel()
        if panel is None:
            why = "Click a panel first, or use the ⤓ in its title."
            self._window.notifications.show_message(Level.WARNING, "Which panel?", why)
            return
        path = self._ask_path(panel.name, kind)
        if path is not None:
            self.save_panel_to(path, kind, panel)

    def window(self) -> None:
        """Ask where, then save the whole window as a picture."""
        path = self._ask_path("window", "png")
        if path is not None:
            self._save(lambda: save_png(path, self._window))

    def save_panel_to(self, path: Path, kind: str, panel: Panel) -> None:
        """Save a panel into this file."""
        if kind == "png":
            self._save(lambda: save_png(path, panel))
        elif kind == "csv":
            self._save(lambda: save_csv(path, panel))
        else:
            state = self._window.context.session.source.state
            self._save(lambda: save_fits(path, panel, state))

    def _save(self, save: Callable[[], tuple[Path, ...]]) -> None:
        try:
            written = save()
        except EscapeError as error:
            self._window.notifications.show_message(Level.ERROR, "Not saved", str(error))
            return
        self._window.set_status_text("saved", f"saved {written[-1].name}")
        self._window.notifications.show_message(Level.GOOD, "Saved", "\n".join(str(path) for path in written))

    def _ask_path(self, name: str, kind: str) -> Path | None:
        moment = datetime.now().strftime("%Y-%m-%d_%H%M%S")
        proposal = str(Path.home() / f"escape_{name}_{moment}.{kind}")
        chosen, _ = QFileDialog.getSaveFileName(self._window, f"Save {name}", proposal, f"*.{kind}")
        return Path(chosen) if chosen else None
