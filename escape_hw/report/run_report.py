"""``report.html`` of a run folder, and one PNG with its matrices and PSFs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.errors import ProductError
from escape_hw.io.storage import write_atomic
from escape_hw.report import html, tables
from escape_hw.report.content import RunContent, read_run
from escape_hw.report.figures import bench as figures_bench
from escape_hw.report.figures import gains as figures_gains
from escape_hw.report.figures import matrix as figures_matrix
from escape_hw.report.figures import registration as figures_registration
from escape_hw.report.figures import residual as figures_residual
from escape_hw.report.figures import style
from escape_hw.report.figures import track as figures_track
from escape_hw.report.paired import paired_section
from escape_hw.report.sweep import sweep_section
from escape_hw.report.verdict import assess

REPORT = "report.html"


def write_report(folder: Path | str) -> Path:
    """Build a run folder's report from its ``result.json`` and products; returns the page.

    Raises
    ------
    ProductError
        Not a run folder, or a product is missing or damaged.
    StorageError
        The page cannot be written.
    """
    run = read_run(folder)
    path = run.folder / REPORT
    write_atomic(path, render_page(run).encode())
    return path


def render_page(run: RunContent) -> str:
    """The page as text."""
    document = run.document
    title = str(document.get("title") or f"{document['command']} on {document['system']}")
    banners = [
        ("simulated", "SIMULATED: every number on this page comes from a digital twin")
        if run.simulated
        else ("hardware", "HARDWARE")
    ]
    if run.partial():
        banners.append(("aborted", "ABORTED BY THE OPERATOR: partial data"))
    lead = " · ".join(
        str(part)
        for part in (
            document["system"],
            document.get("finished_utc") and f"{str(document['finished_utc'])[:19].replace('T', ' ')} UTC",
            f"seed {document['seed']}" if document.get("seed") is not None else None,
            document.get("software") and f"ESCAPE {document['software']}",
            document.get("git") and f"commit {document['git']}",
        )
        if part
    )
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="lead">{html.escape(lead)}</p>',
        _verdict_line(run),
        html.key_values(_key_numbers(run)),
        html.section("Criteria", html.criteria_list(document.get("criteria") or [])),
        _registration_section(run),
        _gains_section(run),
        paired_section(document),
        _loops_section(run),
        sweep_section(document),
        _track_section(run),
        _matrices_section(run),
        _sky_time_section(run),
        _notes_section(run),
        _system_section(run),
        _origin_section(run),
    ]
    return html.page(title, banners, [part for part in parts if part])


def _verdict_line(run: RunContent) -> str:
    verdict = assess(run.document)
    if verdict is None:
        return ""
    kind = verdict.quality.name.lower().replace("_", "-")
    return f'<p class="verdict {kind}" role="status">{html.escape(str(verdict))}</p>'


def _key_numbers(run: RunContent) -> dict[str, str]:
    found: dict[str, str] = {}
    # A matrix and what was computed from it share their frames: one number for both.
    shared: dict[str, list[str]] = {}
    for label, result in run.calibrations.items():
        # Optical gains scale a matrix whose frames are those of an earlier run.
        if not result.frames or run.document["command"] == "gains":
            continue
        text = f"{result.frames:,} ({result.sky_seconds:.3g} s)"
        shared.setdefault(text, []).append(label)
    for text, labels in shared.items():
        found[f"{' and '.join(labels)}: frames"] = text
    for label, gains in run.gains.items():
        found[f"optical gains of {label}: frames"] = f"{gains.frames:,}"
    found |= _track_key_numbers(run.document)
    if run.document.get("wall_seconds") is not None:
        found["wall clock"] = f"{float(run.document['wall_seconds']):.0f} s"
    for label, loop in run.loops.items():
        if loop.strehl is not None:
            found[f"{label}: Strehl ratio, peak"] = tables.format_percent(loop.strehl.peak).strip()
    return found


def _track_key_numbers(document: dict[str, Any]) -> dict[str, str]:
    """What a tracked run comes to."""
    if not document.get("track"):
        return {}
    frames = f"{document['frames']:,} ({document['seconds']:.3g} s)"
    n_accepted = sum(one["accepted"] for one in document["exchanges"])
    found = {
        "closed loop: frames": frames,
        "pokes, of the stroke": f"±{100 * document['poke']:.3g} % each mode",
        "new matrices taken": f"{n_accepted} of {len(document['exchanges'])} proposed",
    }
    if document.get("strehl") is not None:
        found["Strehl ratio, peak, mean"] = f"{100 * document['strehl']:.1f} %"
    return found


def _registration_section(run: RunContent) -> str:
    estimates = run.estimates()
    if not estimates:
        return ""
    caption = "α: registration of the mirror seen by the sensor, with standard errors."
    if any(estimate.repeatability_sigma is not None for estimate in estimates.values()):
        caption += " ± between runs: the part of the error that differs between runs of one set-up."
    if run.injected is not None:
        caption += " Δ / σ: difference from the injected value, which no estimator reads, in standard errors."
    parts = [html.table(tables.registration_table(estimates, run.injected), caption)]
    for number, (label, estimate) in enumerate(estimates.items()):
        what = f" ({label})" if label else ""
        if estimate.iterations:
            parts.append(
                html.figure(
                    f"sprint{number}",
                    figures_registration.convergence(estimate, run.injected),
                    f"SPRINT convergence{what}: step norm (top; a gap where the model changed) and the "
                    "parameters per iteration. Band: final value with its standard error."
                    + (" Dotted: injected value." if run.injected is not None else ""),
                )
            )
        parts.append(_residual_map(run, number, label, estimate))
        if estimate.influence_profile is not None:
            parts.append(
                html.figure(
                    f"influence{number}",
                    figures_registration.influence_profile(estimate.influence_profile),
                    f"Influence functions that SPRINT has found{what}: radial profile, of edge actuators "
                    "along the edge. Bands: standard errors. 'escape influence' writes them as a file.",
                )
            )
    by_name = {label or "ESCAPE": estimate for label, estimate in estimates.items()}
    parts.append(html.note_list(_notes_by_result({k: one.warnings for k, one in by_name.items()}), "bad"))
    parts.append(html.note_list(_notes_by_result({k: one.notes for k, one in by_name.items()})))
    return html.section("Registration", *parts)


def _notes_by_result(notes: Mapping[str, Iterable[str]]) -> list[str]:
    """Each note once; where there are several results, after the labels of those that have it."""
    labels: dict[str, list[str]] = {}
    for label, texts in notes.items():
        for text in dict.fromkeys(texts):
            labels.setdefault(text, []).append(label)
    return [f"{' and '.join(who)}: {text}" if len(notes) > 1 else text for text, who in labels.items()]


def _residual_map(run: RunContent, number: int, label: str, estimate: RegistrationEstimate) -> str:
    """The residual of the fit over the pupil and the mirror, if it was judged."""
    if estimate.goodness_of_fit is None:
        return ""
    result = next(one for one in run.calibrations.values() if one.registration is estimate)
    valid = (result.measured or result.matrix).valid
    drawing = figures_residual.residual_map(estimate.goodness_of_fit, valid, run.layout, run.places_m)
    caption = (
        f"Residual of the fit{f' ({label})' if label else ''}: rms over all modes and both slopes of every "
        "sub-aperture (left), and over all slopes of every actuator (right), in standard errors. Noise alone "
        "is 1. Red border: more than three times the median. Grey: not poked."
    )
    return html.figure(f"residual-map{number}", drawing, caption)


def _gains_section(run: RunContent) -> str:
    parts = []
    for number, (label, result) in enumerate(run.gains.items()):
        if result.rounds:
            relative = "its matrix" if result.comparisons else f"the {label} matrix"
            caption = (
                f"Optical gain of every mode relative to {relative}, with standard errors, and the trend "
                "with its own."
            )
            parts.append(html.figure(f"og{number}", figures_gains.optical_gains(result), caption))
        caption = (
            "Top: effective gain of the loop and residual wavefront at each gain tried on the way to the "
            "target. Bottom: change of the optical gains in each round."
        )
        parts.append(html.figure(f"bootstrap{number}", figures_gains.bootstrap(result), caption))
        caption = "Rounds of the measurement. Strehl lost: due to the pokes, relative."
        parts.append(html.table(tables.rounds_table(result), caption))
        parts.append(html.note_list(list(result.notes)))
    return html.section("Optical gains", *parts) if parts else ""


def _loops_section(run: RunContent) -> str:
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
    if scans := run.document.get("scans"):
        caption = (
            "Search for each matrix's own best gain; without the gains at which the loop diverged, or its "
            "residual grew to the end."
        )
        parts.append(html.figure("gains", figures_bench.gain_scan(scans), caption))
    notes = _notes_by_result({label: loop.notes for label, loop in run.loops.items()})
    return html.section("Closed loop", *parts, html.note_list(notes))


def _track_section(run: RunContent) -> str:
    track = run.document.get("track")
    if not track or not track["seconds"]:
        return ""
    exchanges, alarms = run.document["exchanges"], run.document["alarms"]
    injected = run.document.get("injected_course")
    drawing = figures_track.track_figure(track, exchanges, alarms, injected)
    caption = (
        "Live registration, optical gain and image quality, with standard errors. "
        "Vertical dotted lines: exchanges of the matrix. Vertical solid lines: alarms."
        + ("" if injected is None else " Dotted time series: injected values, which no estimator reads.")
    )
    lines = tuple(
        (
            f"{one['seconds']:.0f}", "exchanged" if one["accepted"] else "proposed",
            f"{one['mismatch']:.1%} ± {one['mismatch_sigma']:.1%}",
            f"{one.get('min_loop_gain', one.get('slowest')):.3f}",
            f"{one.get('max_loop_gain', one.get('fastest')):.3f}",
        )
        for one in exchanges
    )  # fmt: skip
    parts = [html.figure("track", drawing, caption)]
    if lines:
        heads = ("seconds", "", "change of the matrix", "smallest loop gain", "largest loop gain")
        what = (
            "New matrices. Loop gains: of the modes with the previous matrix, relative to the nominal gain."
        )
        parts.append(html.table(tables.Table(heads, lines), what))
    parts.append(html.note_list([f"after {one['seconds']:.0f} s: {one['text']}" for one in alarms], "bad"))
    note = run.document.get("injected_note")
    parts.append(html.note_list([note] if note else []))
    return html.section("Tracking", *parts)


def _matrices_section(run: RunContent) -> str:
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
                "Signal-to-noise ratio (dotted: 1) and standard error of the slopes, rms over the "
                "sub-apertures, of modes whose rms surface is the full stroke of an actuator. The errors of "
                "a computed matrix are those of its registration and its gain, which all slopes share.",
            )
        )
    notes = {label: _matrix_notes(result) for label, result in run.calibrations.items()}
    return html.section("Interaction matrices", *parts, html.note_list(_notes_by_result(notes)))


def _matrix_notes(result: CalibrationResult) -> list[str]:
    """Notes of a calibration without those of its registration, which are stated with it."""
    estimate = result.registration
    stated = () if estimate is None else (*estimate.warnings, *estimate.notes)
    return [note for note in result.notes if note not in stated]


def _notes_section(run: RunContent) -> str:
    """Notes of the run that are those of none of its results."""
    stated = {note for result in run.results() for note in result.notes}
    notes = [note for note in run.document.get("notes") or [] if note not in stated]
    return html.section("Notes", html.note_list(notes)) if notes else ""


def _sky_time_section(run: RunContent) -> str:
    curves = run.document.get("sky_time")
    if not curves:
        return ""
    drawing = figures_registration.error_curves(curves)
    # Version 0.1.0 called them plants.
    number = curves.get("realisations", curves.get("plants"))
    realisations = f", rms over {number} random registration{'s' * (number > 1)}" if number else ""
    caption = f"Error of the registration against the frames used{realisations}, with the Cramér-Rao bound."
    fewest_frames = curves.get("fewest_frames") or {}
    if fewest_frames:
        met = ", ".join(f"{name} {count or 'none of these'}" for name, count in fewest_frames.items())
        caption += f" Fewest frames that meet every goal: {met}."
    calibration_notes = html.note_list([curves["note"]] if "note" in curves else [])
    return html.section("Sky time", html.figure("skytime", drawing, caption), calibration_notes)


def _mirror_figure(run: RunContent, command: NDArray[np.float64]) -> Figure | None:
    """Map of the command, when the run has the actuators' positions."""
    layout, positions = run.layout, run.places_m
    if layout is not None and command.size == int(layout.sum()):
        return figures_bench.mirror_on_grid(command, layout)
    if positions is not None and command.size == len(positions):
        return figures_bench.mirror_without_grid(command, positions)
    return None


def _describe_counts(frame: NDArray[np.generic], run: RunContent) -> str:
    """The brightest pixel of a frame, and where the camera saturates."""
    text = f"Brightest pixel: {float(frame.max()):,.0f} ADU"
    return (
        f"{text}." if run.full_scale is None else f"{text}; the camera saturates at {run.full_scale:,} ADU."
    )


def _system_section(run: RunContent) -> str:
    parts = []
    for calibration in run.calibrations.values():
        if calibration.mean_frame is not None:
            drawing = figures_bench.sensor_frame(calibration.mean_frame, calibration.grid, "mean frame")
            caption = (
                "Mean frame of the sensor, colours by the square root of the counts. Outlines: sub-apertures "
                f"or pupil images. {_describe_counts(calibration.mean_frame, run)}"
            )
            parts.append(html.figure("mean", drawing, caption))
            break
    label, loop = next(reversed(run.loops.items()), ("", None))
    if loop is not None and loop.last_frame is not None:
        drawing = figures_bench.sensor_frame(loop.last_frame, None, "last frame")
        caption = (
            f"The last sensor frame of the {label} loop, colours by the square root of the counts. "
            f"{_describe_counts(loop.last_frame, run)}"
        )
        parts.append(html.figure("frame", drawing, caption))
    shape = None if loop is None else _mirror_figure(run, loop.last_command)
    if shape is not None:
        parts.append(html.figure("mirror", shape, f"The last mirror command of the {label} loop."))
    response = next((r.response for r in run.calibrations.values() if r.response is not None), None)
    if response is not None:
        caption = "Temporal response of mirror and sensor, from the pokes themselves, with standard errors."
        parts.append(html.figure("response", figures_bench.temporal_response(response), caption))
    return html.section("Sensor and mirror", html.figure_row(*parts))


def _origin_section(run: RunContent) -> str:
    rows = tuple(
        (name, path.name, run.digests.get(name, "–"))
        for name, path in run.document["products"].items()
        if path.suffix == ".fits"
    )
    files = html.table(tables.Table(("Product", "file", "SHA-256"), rows, numeric=False)) if rows else ""
    return html.section(
        "Origin",
        files,
        html.collapsible("Configuration", run.config_text),
        html.collapsible("Log", run.log_text),
    )


#: Modes shown.
_MODES = 5


def write_picture(folder: Path | str, path: Path) -> Path:
    """Draw the matrices and PSFs of a run folder, such as ``escape reproduce`` leaves, as PNG.

    Raises
    ------
    ProductError
        Not a run folder, damaged, or without matrix or image.
    StorageError
        The picture cannot be written.
    """
    run = read_run(folder)
    write_atomic(path, style.png(draw_picture(run), dpi=130))
    return path


def draw_picture(run: RunContent) -> Figure:
    """The picture as a figure; see :func:`write_picture`."""
    matrices = run.matrices()
    if not matrices or not any(loop.psf is not None for loop in run.loops.values()):
        raise ProductError(f"{run.folder}: holds no matrix or no closed-loop image to draw")
    left = 1.0 + 2.15 * len(matrices)
    figure = style.new_figure(left + 5.3, 6.2)
    about = f"{run.document['system']}, {'SIMULATED' if run.simulated else 'hardware'}"
    figure.suptitle(about, x=0.01, ha="left", color=style.MUTED, fontsize=9)
    parts = figure.subfigures(1, 2, squeeze=False, width_ratios=[left, 5.3], wspace=0.02)[0]
    for part, title in zip(parts, ("Interaction matrices", "Closed-loop images"), strict=True):
        part.set_facecolor("none")
        part.suptitle(title, color=style.INK, fontsize=12, fontweight="bold")
    figures_matrix.draw_mode_maps(parts[0], matrices, _MODES)
    figures_bench.draw_psfs(parts[1], run.loops, run.psf_px, rows=2)
    return figure
