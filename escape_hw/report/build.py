"""``report.html``: one self-contained page from a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.io.storage import write_atomic
from escape_hw.report import (
    figures_bench,
    figures_gains,
    figures_matrix,
    figures_registration,
    figures_track,
    html,
    tables,
)
from escape_hw.report.content import RunContent, read_run
from escape_hw.report.sweep_section import sweep_section

REPORT = "report.html"


def write_report(folder: Path | str) -> Path:
    """Build a run folder's report from its ``result.json`` and products.

    Returns
    -------
    Path
        The page written.

    Raises
    ------
    ProductError
        Not a run folder, or a product is missing or damaged.
    StorageError
        The page cannot be written.
    """
    run = read_run(folder)
    path = run.folder / REPORT
    write_atomic(path, render(run).encode())
    return path


def render(run: RunContent) -> str:
    """The page as text."""
    document = run.document
    title = str(document.get("title") or f"{document['command']} on {document['system']}")
    bands = [
        ("simulated", "SIMULATED: every number on this page comes from a digital twin")
        if run.simulated
        else ("hardware", "HARDWARE")
    ]
    if run.partial():
        bands.append(("aborted", "ABORTED BY THE OPERATOR: partial data"))
    lead = " · ".join(
        str(part)
        for part in (
            document["system"],
            document.get("finished_utc") and f"{str(document['finished_utc'])[:19].replace('T', ' ')} UTC",
            f"seed {document['seed']}" if document.get("seed") is not None else None,
            document.get("software") and f"ESCAPE {document['software']}",
        )
        if part
    )
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="lead">{html.escape(lead)}</p>',
        html.facts(_facts(run)),
    ]
    parts += [
        _verdict(document),
        _registration(run),
        _gains(run),
        _loops(run),
        sweep_section(document),
        _track(run),
        _matrices(run),
        _sky_time(run),
        _bench(run),
    ]
    parts.append(_origin(run))
    return html.page(title, bands, [part for part in parts if part])


def _facts(run: RunContent) -> dict[str, str]:
    found: dict[str, str] = {}
    # A matrix and what was computed from it share their frames: one number for both.
    shared: dict[str, list[str]] = {}
    for label, result in run.calibrations.items():
        if not result.frames:
            continue
        text = f"{result.frames:,} ({result.sky_seconds:.3g} s)".replace(",", "\u2009")
        shared.setdefault(text, []).append(label)
    for text, labels in shared.items():
        found[f"{' and '.join(labels)}: frames"] = text
    found |= _track_facts(run.document)
    if run.document.get("wall_seconds") is not None:
        found["wall clock"] = f"{float(run.document['wall_seconds']):.0f} s"
    for label, loop in run.loops.items():
        if loop.strehl is not None:
            found[f"{label}: Strehl ratio, peak"] = tables.percent(loop.strehl.peak).strip()
    return found


def _track_facts(document: dict[str, Any]) -> dict[str, str]:
    """What a tracked run comes to."""
    if not document.get("track"):
        return {}
    frames = f"{document['frames']:,} ({document['seconds']:.3g} s)".replace(",", "\u2009")
    taken = sum(one["accepted"] for one in document["exchanges"])
    found = {
        "closed loop: frames": frames,
        "pokes, of the stroke": f"±{100 * document['poke']:.3g} % each mode",
        "new matrices taken": f"{taken} of {len(document['exchanges'])} proposed",
    }
    if document.get("strehl") is not None:
        found["Strehl ratio, peak, mean"] = f"{100 * document['strehl']:.1f} %"
    return found


def _verdict(document: dict[str, Any]) -> str:
    return html.section("Criteria", html.checks(document.get("criteria") or []))


def _registration(run: RunContent) -> str:
    estimates = run.estimates()
    if not estimates:
        return ""
    caption = "Registration of the mirror seen by the sensor, with standard errors."
    if run.planted is not None:
        caption += " Δ: difference from the planted truth, which is shown only here; no estimator reads it."
    parts = [html.table(tables.registration_table(estimates, run.planted), caption)]
    for number, (label, estimate) in enumerate(estimates.items()):
        if estimate.iterations:
            what = f" ({label})" if label else ""
            parts.append(
                html.figure(
                    f"sprint{number}",
                    figures_registration.convergence(estimate, run.planted),
                    f"SPRINT convergence{what}: step norm (top) and the parameters per iteration. "
                    "Band: final value with its standard error."
                    + (" Dotted: planted truth." if run.planted is not None else ""),
                )
            )
        parts.append(html.notes(list(estimate.warnings), "bad"))
        parts.append(html.notes(list(estimate.notes)))
    return html.section("Registration", *parts)


def _gains(run: RunContent) -> str:
    parts = []
    for number, (label, result) in enumerate(run.gains.items()):
        if result.rounds:
            caption = (
                f"Optical gain of every mode relative to the {label} matrix, with standard errors, and its "
                "smooth course with its own."
            )
            parts.append(html.figure(f"og{number}", figures_gains.optical_gains(result), caption))
        caption = (
            "First closure: effective gain and residual at each gain tried. Rounds: change of the gains."
        )
        parts.append(html.figure(f"bootstrap{number}", figures_gains.bootstrap(result), caption))
        parts.append(html.table(tables.rounds_table(result), "Rounds of the bootstrap."))
        parts.append(html.notes(list(result.notes)))
    return html.section("Optical gains", *parts) if parts else ""


def _loops(run: RunContent) -> str:
    if not run.loops:
        return ""
    parts = [html.table(tables.strehl_table(run.loops), "rms: residual wavefront seen by the sensor.")]
    if any(loop.psf is not None for loop in run.loops.values()):
        parts.append(
            html.figure(
                "psf",
                figures_bench.stacked_psfs(run.loops, run.psf_px),
                "Stacked closed-loop PSFs and the model PSF taken without turbulence, logarithmic stretch. "
                "Strehl ratios from top to bottom: maximum, optical transfer function, energy within 3 "
                "pixels of the maximum, each against the model.",
            )
        )
    if any(loop.residual_nm.size for loop in run.loops.values()):
        parts.append(
            html.figure(
                "residual",
                figures_bench.residual_strip(run.loops),
                "Residual wavefront seen by the sensor, from the closing of the loop on; logarithmic.",
            )
        )
    scans = run.document.get("scans") or {}
    if scans:
        parts.append(
            html.figure("gains", figures_bench.gain_scan(scans), "Search for each matrix's own best gain.")
        )
    return html.section("Closed loop", *parts)


def _track(run: RunContent) -> str:
    track = run.document.get("track")
    if not track or not track["seconds"]:
        return ""
    exchanges, alarms = run.document["exchanges"], run.document["alarms"]
    planted = run.document.get("planted_course")
    drawing = figures_track.course(track, exchanges, alarms, planted)
    caption = (
        "Live registration, optical gain and image quality, with standard errors. "
        "Upright and dotted: a new matrix was taken into use. Upright and full: an alarm."
        + (
            ""
            if planted is None
            else " Dotted course: planted truth, shown only here; no estimator reads it."
        )
    )
    lines = tuple(
        (
            f"{one['seconds']:.0f}", "exchanged" if one["accepted"] else "proposed",
            f"{one['mismatch']:.1%} ± {one['mismatch_sigma']:.1%}",
            f"{one['slowest']:.3f}", f"{one['fastest']:.3f}",
        )
        for one in exchanges
    )  # fmt: skip
    parts = [html.figure("track", drawing, caption)]
    if lines:
        heads = ("seconds", "", "change of the matrix", "slowest mode", "fastest mode")
        what = (
            "New matrices. Slowest, fastest: loop gain of the modes with the matrix before; 1 is asked for."
        )
        parts.append(html.table(tables.Table(heads, lines), what))
    parts.append(html.notes([f"after {one['seconds']:.0f} s: {one['text']}" for one in alarms], "bad"))
    note = run.document.get("planted_note")
    parts.append(html.notes([note] if note else []))
    return html.section("Tracking", *parts)


def _matrices(run: RunContent) -> str:
    matrices = run.matrices()
    if not matrices:
        return ""
    parts = [
        html.figure(
            "modes",
            figures_matrix.mode_maps(matrices),
            "Interaction matrices: x and y slope maps of evenly spaced modes, each divided by its rms slope.",
        )
    ]
    if any((matrix.sigma > 0).any() for matrix in matrices.values()):
        parts.append(
            html.figure(
                "errors",
                figures_matrix.errors_per_mode(matrices),
                "Signal-to-noise ratio and standard error per mode. The errors of a computed matrix are "
                "those of its registration and its gain, which all slopes share.",
            )
        )
    remarks = [f"{label}: {note}" for label, result in run.calibrations.items() for note in result.notes]
    return html.section("Interaction matrices", *parts, html.notes(remarks))


def _sky_time(run: RunContent) -> str:
    curves = run.document.get("sky_time")
    if not curves:
        notes = run.document.get("notes") or []
        return html.section("Sky time", html.notes(notes)) if notes else ""
    drawing = figures_registration.error_curves(curves)
    plants = f", rms over {curves['plants']} random plants" if "plants" in curves else ""
    caption = f"Error of the registration against the frames used{plants}, with the Cramér-Rao bound."
    fewest = curves.get("fewest_frames") or {}
    if fewest:
        met = ", ".join(f"{name} {count or 'none of these'}" for name, count in fewest.items())
        caption += f" Fewest frames that meet every goal: {met}."
    remarks = html.notes([curves["note"]] if "note" in curves else [])
    return html.section("Sky time", html.figure("skytime", drawing, caption), remarks)


def _mirror(run: RunContent, command: NDArray[np.float64]) -> Figure | None:
    """The command on the map of the actuators, when the run knows where they stand."""
    layout, places = run.layout, run.places_m
    if layout is not None and command.size == int(layout.sum()):
        return figures_bench.mirror(command, layout)
    if places is not None and command.size == len(places):
        return figures_bench.mirror_without_grid(command, places)
    return None


def _bench(run: RunContent) -> str:
    parts = []
    calibration = next((r for r in run.calibrations.values() if r.mean_frame is not None), None)
    if calibration is not None and calibration.mean_frame is not None:
        drawing = figures_bench.sensor(calibration.mean_frame, calibration.grid, "mean frame")
        parts.append(html.figure("mean", drawing, "Mean sensor frame and what was found on it."))
    label, loop = next(reversed(run.loops.items()), ("", None))
    if loop is not None and loop.last_frame is not None:
        drawing = figures_bench.sensor(loop.last_frame, None, "one frame")
        parts.append(html.figure("frame", drawing, f"The last sensor frame of the {label} loop."))
    shape = None if loop is None else _mirror(run, loop.last_command)
    if shape is not None:
        parts.append(html.figure("mirror", shape, f"The last mirror command of the {label} loop."))
    response = next((r.response for r in run.calibrations.values() if r.response is not None), None)
    if response is not None:
        caption = "Temporal response of mirror and sensor, from the pokes themselves, with standard errors."
        parts.append(html.figure("response", figures_bench.temporal_response(response), caption))
    return html.section("Bench", html.side_by_side(*parts))


def _origin(run: RunContent) -> str:
    rows = tuple(
        (name, path.name, run.digests.get(name, "–"))
        for name, path in run.document["products"].items()
        if path.suffix == ".fits"
    )
    files = html.table(tables.Table(("Product", "file", "SHA-256"), rows, numeric=False)) if rows else ""
    return html.section(
        "Origin",
        files,
        html.folded("Configuration", run.config_text),
        html.folded("Log", run.log_text),
    )
