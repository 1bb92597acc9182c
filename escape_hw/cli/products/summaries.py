"""Summaries of products for ``escape show``, by kind."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType

from escape_hw.cli.formatting import format_calibration, profile_lines, registration_remarks, rich_table
from escape_hw.errors import ProductError
from escape_hw.io import documents
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.frames import KIND_FRAMES, load_frames
from escape_hw.io.fits.gains import KIND_GAINS, load_gains
from escape_hw.io.fits.influence import KIND_INFLUENCE, load_influence
from escape_hw.io.fits.loop import KIND_PSF, load_loop
from escape_hw.io.fits.matrix import KIND_MATRIX, load_matrix
from escape_hw.io.fits.offsets import KIND_OFFSETS, load_offsets
from escape_hw.io.fits.pixels import PixelKind, load_pixels
from escape_hw.io.fits.run_state import KIND_STATE, load_state
from escape_hw.io.fits.telemetry import KIND_TELEMETRY, load_telemetry
from escape_hw.report.tables import registration_table, rounds_table, strehl_table

#: Fields of the document, and lines for the terminal.
ProductSummary = tuple[dict[str, Any], list[RenderableType]]


def summarise_product(kind: str, file: Path) -> ProductSummary:
    """Document and lines of a product."""
    summarise = _SUMMARIES.get(kind)
    if summarise is None:
        raise ProductError(f"{file}: unknown kind {kind!r}; known are {', '.join(sorted(_SUMMARIES))}")
    return summarise(file)


def _matrix(file: Path) -> ProductSummary:
    product = load_matrix(file)
    document = {**documents.calibration_document(product.result), "metrics": product.matrix.metrics}
    lines: list[RenderableType] = [*format_calibration(product.result)]
    if product.registration is not None:
        lines.append(rich_table(registration_table({"": product.registration})))
        lines += registration_remarks(product.registration, product.result.notes)
    return document, lines


def _gains(file: Path) -> ProductSummary:
    result = load_gains(file).result
    return documents.gains_document(result), [rich_table(rounds_table(result))]


def _telemetry(file: Path) -> ProductSummary:
    result = load_telemetry(file).result
    frames, n_slopes = result.slopes.shape
    document = {"frames": frames, "n_slopes": n_slopes, "rate_hz": result.rate_hz}
    return document, [f"{frames} frames of {n_slopes} slopes at {result.rate_hz:.6g} Hz"]


def _influence(file: Path) -> ProductSummary:
    found = load_influence(file).result
    document = {
        "n_act": len(found.gain), "pitch_m": found.pitch_m, "shape": list(found.surfaces.shape[1:]),
        "profile": asdict(found.profile), "model_fits": found.model_fits,
    }  # fmt: skip
    return document, [
        f"influence functions of {len(found.gain)} actuators, {int(found.edge.sum())} at the edge",
        *(["of a fit whose model did not fit"] if found.model_fits is False else []),
        *profile_lines(found.profile),
    ]


def _loop(file: Path) -> ProductSummary:
    result = load_loop(file).result
    return documents.loop_document(result), [rich_table(strehl_table({result.method: result}))]


def _frames(file: Path) -> ProductSummary:
    result = load_frames(file).result
    n, rows, columns = result.data.shape
    region, seconds = result.settings.region, 1e-9 * float(np.ptp(result.exposed_ns))
    counts = {
        "min": int(result.data.min()), "max": int(result.data.max()), "mean": float(result.data.mean()),
    }  # fmt: skip
    saturated = int(result.n_saturated.max())
    document = {
        "frames": n, "shape": [rows, columns], "camera": result.camera, "serial": result.serial,
        "settings": asdict(result.settings), "rate_hz": result.rate_hz, "lost_frames": result.lost_frames,
        "first_index": int(result.index[0]), "first_exposed_ns": int(result.exposed_ns[0]),
        "seconds": seconds, "counts": counts, "saturated": saturated,
        "dark_subtracted": False, "flat_divided": False,
    }  # fmt: skip
    measured = f", {result.rate_hz:.6g} Hz by their times" if n > 1 else ""
    return document, [
        f"{n} frames of {columns} x {rows} pixels from {result.camera} {result.serial}, "
        f"region at column {region.x}, row {region.y}",
        f"exposure {result.settings.exposure_s:.6g} s, gain {result.settings.gain_db:g} dB, set to "
        f"{result.settings.frame_rate_hz:.6g} Hz{measured}",
        f"frame {result.index[0]} to {result.index[-1]} in {seconds:.6g} s, {result.lost_frames} lost; the "
        f"first exposure ended at {1e-9 * float(result.exposed_ns[0]):.6f} s of the camera's clock",
        f"counts {counts['min']} to {counts['max']}, mean {counts['mean']:.1f}, at most {saturated} pixels "
        "of a frame saturated; no dark subtracted, no flat divided",
    ]


def _state(file: Path) -> ProductSummary:
    state = load_state(file)
    method, taken = str(state.identity.get("method")), state.values.get("taken")
    resume = f"escape calibrate --resume {shlex.quote(str(file.absolute().parent))}"
    frames = "" if taken is None else f" after {taken} frames"
    document = {"method": method, "frames": taken, "request": state.values.get("request"), "resume": resume}
    return document, [f"a calibration by {method}, interrupted{frames}", f"resume with: {resume}"]


def _pixels(kind: PixelKind) -> Callable[[Path], ProductSummary]:
    name, unit = ("dark frame", " counts") if kind == "DARK" else ("relative response", "")

    def summarise(file: Path) -> ProductSummary:
        image = load_pixels(file, kind).result
        rows, columns = image.shape
        values = {
            "mean": float(image.mean()), "scatter": float(image.std()),
            "min": float(image.min()), "max": float(image.max()),
        }  # fmt: skip
        return {"shape": [rows, columns], **values}, [
            f"{name} of {columns} x {rows} pixels: mean {values['mean']:.4g}{unit}, scatter "
            f"{values['scatter']:.4g}{unit} rms, {values['min']:.4g} to {values['max']:.4g}{unit}"
        ]

    return summarise


def _offsets(file: Path) -> ProductSummary:
    offsets = load_offsets(file).result
    peak = float(np.abs(offsets.flat).max(initial=0.0))
    _, rows, columns = offsets.slopes.shape
    document = {
        "terms": dict(offsets.terms), "n_modes": offsets.modes.size, "slopes": [rows, columns],
        "n_act": offsets.flat.size, "flat_peak": peak,
    }  # fmt: skip
    slopes = f"of {columns} x {rows} sub-apertures" if rows else "not measured"
    flat = (
        f"{offsets.flat.size} actuators, at most {peak:.3g} of full stroke" if offsets.flat.size else "zeros"
    )
    return document, [
        *(f"{name}: {value:.6g} nm rms wavefront" for name, value in offsets.terms.items()),
        f"offset of the reference slopes: {slopes}",
        f"flat shape: {flat}",
    ]


def _screen(file: Path) -> ProductSummary:
    hdus, _ = fits_file.read(file, fits_file.KIND_SCREEN)
    panel = str(hdus[0].header.get("PANEL", ""))
    arrays = [
        {"name": hdu.name, "shape": list(hdu.shape), "unit": str(hdu.header.get("BUNIT", ""))}
        for hdu in hdus[1:]
    ]
    return {"panel": panel, "arrays": arrays}, [
        f"exported from the panel '{panel}' of the window",
        *("{name}: {shape} {unit}".format_map(one).rstrip() for one in arrays),
    ]


_SUMMARIES: dict[str, Callable[[Path], ProductSummary]] = {
    "DARK": _pixels("DARK"),
    "FLAT": _pixels("FLAT"),
    KIND_FRAMES: _frames,
    KIND_GAINS: _gains,
    KIND_INFLUENCE: _influence,
    KIND_MATRIX: _matrix,
    KIND_OFFSETS: _offsets,
    KIND_PSF: _loop,
    fits_file.KIND_SCREEN: _screen,
    KIND_STATE: _state,
    KIND_TELEMETRY: _telemetry,
}
