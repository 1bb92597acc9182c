"""Curves and tables of an analysed recording. No widgets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_gui.views.images import mask_from_rows
from escape_hw.io.run_folder import run_time
from escape_hw.remote.state import Geometry, RecordingState

if TYPE_CHECKING:
    from escape_hw.pipeline.telemetry import TelemetryAnalysis

#: Number of the choice "all modes".
ALL_MODES = 0


@dataclass(frozen=True, slots=True)
class Spectra:
    """Spectra of a mode, the sum over all, or the mean of the slopes.

    Frequency in Hz, densities in ``unit``, rejection in dB. Slopes have a residual only.
    """

    unit: str
    frequency_hz: NDArray[np.float64]
    residual: NDArray[np.float64]
    open_loop: NDArray[np.float64]
    rejection_db: NDArray[np.float64]
    measured_db: NDArray[np.float64]

    @classmethod
    def of(cls, analysis: TelemetryAnalysis, mode: int, slopes: bool = False) -> Spectra:
        """Spectra of a mode, counted from 1, of :data:`ALL_MODES`, or of the slopes."""
        if slopes:
            none = np.zeros(0)
            rejection = 10 * np.log10(analysis.rejection) if analysis.mode_psd.shape[1] else none
            unit = "slope unit² / Hz"
            return cls(unit, analysis.frequency_hz, analysis.slope_psd, none, rejection, none)
        part = slice(None) if mode == ALL_MODES else slice(mode - 1, mode)
        residual = analysis.mode_psd[:, part].sum(axis=1)
        open_loop = analysis.open_loop_psd[:, part].sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            measured = 10 * np.log10(residual / open_loop)
        return cls(
            "nm² / Hz", analysis.frequency_hz, residual, open_loop, 10 * np.log10(analysis.rejection),
            np.where(np.isfinite(measured), measured, np.nan),
        )  # fmt: skip


def size_text(size: float) -> str:
    """A number of bytes in MB or GB."""
    return f"{size / 1e9:,.2f} GB" if size >= 1e9 else f"{size / 1e6:,.1f} MB"


def describe_growth(recording: RecordingState, seconds: float) -> str:
    """Progress or end of a recording in a line."""
    if not recording.path:
        return "no recording yet"
    parts = [f"{recording.written:,} entries", size_text(recording.size)]
    if recording.recording:
        parts.insert(0, f"{seconds:,.0f} s")
    if recording.dropped:
        parts.append(f"{recording.dropped:,} dropped")
    if recording.fault:
        parts.append(recording.fault)
    return " · ".join(parts)


def describe_analysis(analysis: TelemetryAnalysis, folder: Path | None) -> str:
    """Time of the recording, frames, and what is missing, in a line."""
    time = "" if folder is None else f"{run_time(folder)} · "
    lost = f", {analysis.n_lost} lost" if analysis.n_lost else ""
    missing = ""
    if not analysis.mode_psd.shape[1]:
        missing = " · no residual: the loop was open"
    elif not analysis.open_loop_psd.shape[1]:
        missing = " · the matrix cannot be read: no modes without correction"
    return f"{time}{analysis.n_frames:,} frames, {analysis.seconds:.1f} s{lost}{missing}"


def suspicious_rows(analysis: TelemetryAnalysis, geometry: Geometry) -> list[tuple[str, str, str]]:
    """Element, place (row, column from 0) and reason."""
    places = {
        "sub-aperture": np.argwhere(mask_from_rows(geometry.valid)),
        "actuator": np.argwhere(mask_from_rows(geometry.layout)),
    }
    rows = []
    for one in analysis.suspicious:
        at = places[one.kind]
        place = f"row {at[one.number][0]}, column {at[one.number][1]}" if one.number < len(at) else ""
        rows.append((f"{one.kind} {one.number}", place, one.reason))
    return rows
