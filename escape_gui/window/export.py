"""Exports what a panel shows: image (PNG), table (CSV), arrays (FITS)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from PySide6.QtCore import QBuffer, QIODevice
from PySide6.QtWidgets import QFileDialog, QWidget

from escape_gui.client.session import Session
from escape_gui.panels.base import ExportArray, Panel
from escape_gui.widgets.controls import Level
from escape_gui.window.notifications import NotificationBar
from escape_hw.errors import EscapeError
from escape_hw.io.provenance import Provenance
from escape_hw.io.storage import write_atomic
from escape_hw.remote.state import State


def save_png(path: Path, widget: QWidget) -> tuple[Path, ...]:
    """Save an image of a widget and return the path; raise `StorageError` if it cannot be written."""
    buffer = QBuffer()
    buffer.open(QIODevice.OpenModeFlag.WriteOnly)
    widget.grab().save(buffer, "PNG")
    write_atomic(path, bytes(buffer.data().data()))
    return (path,)


def save_csv(path: Path, panel: Panel) -> tuple[Path, ...]:
    """Save a panel's arrays as text and return the paths: one file per array.

    Raises `EscapeError` if the panel has no arrays yet, `StorageError` if a file cannot be written.
    """
    arrays = _arrays(panel)
    written = []
    for one in arrays:
        target = path if len(arrays) == 1 else path.with_name(f"{path.stem}_{one.name}{path.suffix}")
        write_atomic(target, _csv(one).encode())
        written.append(target)
    return tuple(written)


def save_fits(path: Path, panel: Panel, state: State) -> tuple[Path, ...]:
    """Save a panel's arrays as extensions of one FITS file with checksums, and return the path.

    Raises `EscapeError` if the panel has no arrays yet, `StorageError` if the file cannot be written.
    """
    from escape_hw.io.fits import file as fits_file

    arrays = _arrays(panel)
    origin = Provenance(seed=state.seed if state.simulated else None)
    head = fits_file.primary_hdu(fits_file.KIND_SCREEN, state.system, state.simulated, False, origin)
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
        raise EscapeError(f"{panel.title} has no data to export yet; save an image instead")
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
    """Saves panels and the window into files that the user chooses, and reports it in a notification."""

    def __init__(
        self,
        window: QWidget,
        session: Session,
        notifications: NotificationBar,
        on_saved: Callable[[Path], None],
    ) -> None:
        self._window, self._session = window, session
        self._notifications, self._on_saved = notifications, on_saved

    def panel(self, kind: str, panel: Panel | None) -> None:
        """Ask for a path and save a panel, if one has the focus, as ``png``, ``csv`` or ``fits``."""
        if panel is None:
            why = "Click a panel first, or use the ⤓ in its title."
            self._notifications.show_message(Level.NEUTRAL, "Which panel?", why)
        elif path := self._ask_path(panel.name, kind):
            self.save_panel_to(path, kind, panel)

    def window(self) -> None:
        """Ask for a path and save an image of the whole window."""
        if path := self._ask_path("window", "png"):
            self._save(lambda: save_png(path, self._window))

    def save_panel_to(self, path: Path, kind: str, panel: Panel) -> None:
        if kind == "png":
            self._save(lambda: save_png(path, panel))
        elif kind == "csv":
            self._save(lambda: save_csv(path, panel))
        else:
            self._save(lambda: save_fits(path, panel, self._session.source.state))

    def _save(self, save: Callable[[], tuple[Path, ...]]) -> None:
        try:
            written = save()
        except EscapeError as error:
            self._notifications.show_message(Level.ERROR, "Not saved", str(error))
            return
        self._on_saved(written[-1])
        self._notifications.show_message(Level.GOOD, "Saved", "\n".join(str(path) for path in written))

    def _ask_path(self, name: str, kind: str) -> Path | None:
        moment = datetime.now().strftime("%Y-%m-%d_%H%M%S")
        proposal = str(Path.home() / f"escape_{name}_{moment}.{kind}")
        chosen, _ = QFileDialog.getSaveFileName(self._window, f"Save {name}", proposal, f"*.{kind}")
        return Path(chosen) if chosen else None
