"""Tracker on a drifting bench, compared with a loop that uses the true registration and one never updated.

    python benchmarks/studies/loops/tracking.py track --seconds 600 --out tracked
    python benchmarks/studies/loops/tracking.py compare --loop true --out tracked
    python benchmarks/studies/loops/tracking.py compare --loop first --out tracked
    python benchmarks/studies/loops/tracking.py draw --out tracked --figure tracking.png

``track`` calibrates, finds the optical gains on a pyramid, and runs the tracker once over all frames. It
writes its table with the twin's true values (``track.json``; ``live.jsonl`` while it runs). ``compare``
closes another loop for a few seconds at a time, at the same moments of the same turbulence, without pokes:
with the matrix moved to the true registration and scaled to the true gain (``true``), or with the initial
matrix (``first``). Intervals that its file already contains are not repeated. ``draw`` prints the
differences and draws the figure. All take the same options.
"""

from __future__ import annotations

import argparse
import json
import math
from array import array
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import append_line, read_lines, study_parser
from escape_hw.api.procedure import Progress
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function, prepare_sensor
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.calibration.tracking.tracker import track
from escape_hw.errors import CalibrationError
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.report.figures import style
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.bench import SimBench
from escape_sim.devices.true_optical_gains import get_simulated_bench

#: Seconds of tracking that the statistics exclude.
SETTLED_S = 10.0
#: Seconds before and after an exchange that are compared.
TRANSIENT_S = 0.1
#: Largest error of the shift [% of a sub-aperture], and largest loss of the Strehl ratio relative to the loop
#: with the true registration [%].
SHIFT_LIMIT, STREHL_LIMIT = 2.0, 1.0
LABELS = {"true": "true registration, no pokes", "first": "first matrix, no pokes"}
#: Their marks and colours.
MARKS, COLOURS = "os", (style.INK, style.SERIES[1])


def read_comparison(out: Path, loop: str) -> NDArray[np.float64]:
    """Intervals of another loop so far ``(n, 3)``: end in seconds, Strehl ratio, its standard error."""
    return np.array(sorted(read_lines(out / f"{loop}.jsonl"))).reshape(-1, 3)


def draw(out: Path, figure: Path) -> None:
    """Print the errors and draw the figure."""
    tracked = json.loads((out / "track.json").read_text())
    rows = {name: np.array(values, float) for name, values in tracked["rows"].items()}
    truth, t = np.array(tracked["truth"]), rows["seconds"]
    settled = t > SETTLED_S
    for k, name in enumerate(PARAMETERS):
        error = (rows[name] - truth[:, k])[settled]
        chi2 = np.mean(np.square(error / rows[f"{name}_sigma"][settled]))
        rms, worst = np.sqrt(np.mean(error**2)), np.abs(error).max()
        print(
            f"{name}: rms error {rms:.4f}, largest {worst:.4f}, chi2 {chi2:.2f}; mean {error.mean():+.4f}, "
            f"scatter about it {error.std():.4f}"
        )
    gains = np.array(tracked["gains"])
    gains = gains[gains[:, 0] > SETTLED_S]
    relative_error = np.interp(gains[:, 0], t, rows["optical_gain"]) / gains[:, 1] - 1
    print(f"optical gain: mean error {relative_error.mean():+.4f},", end=" ")
    print(f"rms {np.sqrt(np.mean(relative_error**2)):.4f},", end=" ")
    print(
        f"largest {np.abs(relative_error).max():.4f}; true {gains[:, 1].min():.3f} to {gains[:, 1].max():.3f}"
    )
    print(exchange_transients(out, t, rows["exchanged"] > 0))
    others = {}
    for loop in LABELS:
        comparisons = read_comparison(out, loop)
        if len(comparisons):
            others[loop] = comparisons
            print(difference(loop, others[loop], t, rows["strehl"]))
    picture(rows, truth, gains, others).savefig(figure, dpi=110, facecolor="white")


def exchange_transients(out: Path, t: Any, exchanged: Any) -> str:
    """Change of the wavefront error in front of the sensor at exchanges, and at other seconds."""
    ripples = np.load(out / "ripples.npz")
    # An update, and its matrix, is applied at the end of the following second.
    edges, exchanged_here = t[1:-1], exchanged[:-2]
    at = np.searchsorted(ripples["seconds"], edges)
    span = np.searchsorted(ripples["seconds"], edges + TRANSIENT_S) - at
    squares = np.concatenate([[0.0], np.cumsum(np.square(ripples["nm"], dtype=float))])
    after = np.sqrt((squares[at + span] - squares[at]) / span)
    before = np.sqrt((squares[at] - squares[at - span]) / span)
    step = after - before
    if not exchanged_here.any():
        return "no exchange"
    own, others = step[exchanged_here], step[~exchanged_here]
    return (
        f"wavefront in front of the sensor (mean {before.mean():.0f} nm), {TRANSIENT_S:g} s after and before "
        f"{len(own)} exchanges: {own.mean():+.2f} +- {own.std() / np.sqrt(len(own)):.2f} nm, "
        f"rms {own.std():.2f}, largest {np.abs(own).max():.2f}; at the {len(others)} other seconds "
        f"rms {others.std():.2f}, largest {np.abs(others).max():.2f}"
    )


def at_same_times(comparisons: NDArray[np.float64], t: Any, ratios: Any) -> NDArray[np.float64]:
    """Strehl ratios of the tracked loop at the times of another loop's intervals ``(n,)``."""
    return np.array([ratios[np.argmin(np.abs(t - end))] for end in comparisons[:, 0]])


def difference(loop: str, comparisons: NDArray[np.float64], t: Any, ratios: Any) -> str:
    """Mean Strehl ratios of the tracked loop and another one at the same moments, and of their difference."""
    here = at_same_times(comparisons, t, ratios)
    strehl_difference, mean = here - comparisons[:, 1], comparisons[:, 1].mean()
    error = strehl_difference.std(ddof=1) / np.sqrt(len(strehl_difference))
    return (
        f"Strehl ratio: tracked {100 * here.mean():.2f} %, {loop} {100 * mean:.2f} %, tracked minus {loop} "
        f"{100 * strehl_difference.mean():+.2f} +- {100 * error:.2f} % ({len(strehl_difference)} intervals), "
        f"relative {100 * strehl_difference.mean() / mean:+.2f} +- {100 * error / mean:.2f} %; "
        f"last quarter {100 * strehl_difference[-len(strehl_difference) // 4 :].mean():+.2f} %"
    )


def band(panel: Any, t: Any, value: Any, sigma: Any) -> None:
    """Draw a time series with the band of its standard errors."""
    panel.fill_between(t, value - sigma, value + sigma, color=style.SERIES[0], alpha=0.3, lw=0)
    panel.plot(t, value, color=style.SERIES[0], lw=1.2, label="tracked")


def picture(rows: dict[str, Any], truth: Any, gains: Any, others: dict[str, Any]) -> Figure:
    """Shift and its error, rotation, gain, Strehl ratio and its loss, against time."""
    figure = style.new_figure(9.2, 9.0)
    figure.set_layout_engine("constrained", rect=(0, 0, 1, 0.985))
    panels = list(figure.subplots(3, 2, sharex=True).ravel())
    if not others:
        # Nothing to compare the Strehl ratio with.
        panels.pop().remove()
        panels[3].tick_params(labelbottom=True)
        panels[3].set_xlabel("seconds")
    t = rows["seconds"]
    for panel, name, k, title in (
        (panels[0], "shift_x", 0, "shift x [% of a sub-aperture]"),
        (panels[2], "rotation", 2, "rotation [deg]"),
    ):
        band(panel, t, rows[name] - truth[0, k], rows[f"{name}_sigma"])
        panel.plot(t, truth[:, k] - truth[0, k], ":", color=style.INK, lw=1.4, label="true")
        style.style_axes(panel).set_title(f"{title}, since the start", fontsize=9.5)
    band(panels[1], t, rows["shift_x"] - truth[:, 0], rows["shift_x_sigma"])
    panels[1].axhline(0, color=style.INK, lw=0.8)
    for limit in (-SHIFT_LIMIT, SHIFT_LIMIT):
        panels[1].axhline(limit, color=style.MUTED, lw=1.0, ls=":", label="limit" if limit > 0 else None)
    panels[1].margins(y=0.2)
    style.style_axes(panels[1]).set_title("shift x, tracked minus true [% of a sub-aperture]", fontsize=9.5)
    band(panels[3], t, rows["optical_gain"], rows["optical_gain_sigma"])
    panels[3].plot(gains[:, 0], gains[:, 1], "o", ms=3, color=style.INK, label="true")
    style.style_axes(panels[3]).set_title("optical gain, relative to the initial matrix", fontsize=9.5)
    strehl_panel(panels[4], rows, others)
    if others:
        loss_panel(panels[5], rows, others)
    for panel in panels:
        panel.legend(frameon=False, fontsize=8)
    for panel in panels[4:]:
        panel.set_xlabel("seconds")
    return figure


def strehl_panel(panel: Any, rows: dict[str, Any], others: dict[str, Any]) -> None:
    """Strehl ratios of all loops."""
    t, ratio = rows["seconds"], np.isfinite(rows["strehl"])
    panel.errorbar(
        t[ratio], 100 * rows["strehl"][ratio], 100 * rows["strehl_sigma"][ratio],
        color=style.SERIES[0], lw=1.0, elinewidth=0.5, label="tracked, with pokes",
    )  # fmt: skip
    for (loop, comparisons), mark, colour in zip(others.items(), MARKS, COLOURS, strict=False):
        panel.plot(comparisons[:, 0], 100 * comparisons[:, 1], mark, ms=3.5, color=colour, label=LABELS[loop])
    style.style_axes(panel).set_title("Strehl ratio, peak [%]", fontsize=9.5)


def loss_panel(panel: Any, rows: dict[str, Any], others: dict[str, Any]) -> None:
    """Strehl ratios relative to the loop with the true registration."""
    reference = others.get("true")
    for (loop, comparisons), mark, colour in zip(others.items(), MARKS, COLOURS, strict=False):
        if reference is not None and len(reference) == len(comparisons) and loop != "true":
            deficit = 100 * (comparisons[:, 1] / reference[:, 1] - 1)
            panel.plot(comparisons[:, 0], deficit, mark, ms=3.5, color=colour, label=LABELS[loop])
    if reference is not None:
        deficit = 100 * (at_same_times(reference, rows["seconds"], rows["strehl"]) / reference[:, 1] - 1)
        panel.plot(reference[:, 0], deficit, "-", color=style.SERIES[0], lw=1.2, label="tracked, with pokes")
    panel.axhline(-STREHL_LIMIT, color=style.MUTED, lw=1.0, ls=":", label="limit")
    style.style_axes(panel).set_title("Strehl ratio relative to true registration [%]", fontsize=9.5)


#: Seconds of an interval of the other loops, and seconds for which they are closed before it.
COMPARISON_S, CLOSING_S = 5.0, 1.0
#: Modes and wavefronts of the push-pull that measures the true optical gain; size of the poke in strokes.
GAIN_MODES, WAVEFRONTS, GAIN_POKE = 12, 4, 3e-3
#: Seconds from one of those wavefronts to the next.
WAVEFRONT_SPACING_S = 0.4


def drift_overrides(options: argparse.Namespace) -> list[str]:
    """Configuration of the drift: linear in shift x, and a swing of the seeing."""
    rate = options.drift / options.seconds
    return [
        f"twin.drift.rate.shift_x={rate:.8g}",
        f"twin.drift.swing.rotation={options.swing:.8g}",
        f"twin.drift.period_s={options.seconds:.8g}",
        f"twin.seeing.swing={options.seeing:.8g}",
        f"twin.seeing.period_s={options.seconds:.8g}",
        *options.set,
    ]


def open_bench(options: argparse.Namespace) -> System:
    """Open the drifting bench, with its streams of random numbers at their beginning."""
    return open_system(options.system, set=drift_overrides(options), seed=options.seed)


def load_or_measure_start(options: argparse.Namespace) -> tuple[CalibrationResult, NDArray[np.float32]]:
    """Initial calibration and model PSF, measured once on a bench without drift."""
    matrix, image = options.out / "start.fits", options.out / "psf.npy"
    if not matrix.exists():
        with open_system(options.system, set=options.set, seed=options.seed) as bench:
            result = bench.calibrate(frames=options.frames)
            np.save(image, bench.take_model_psf(frames=10))
            if bench.config.sensor.kind == "pyramid":
                result = bench.find_optical_gains(result, accuracy=0.05, frames=2000).rescaled_calibration
            save_matrix(matrix, result)
    return load_matrix(matrix).result, np.load(image)


class WavefrontRms:
    """Records the rms of every wavefront in front of the sensor, mirror included."""

    def __init__(self, twin: SimBench) -> None:
        self._weights = (twin.pupil.lit / np.count_nonzero(twin.pupil.lit)).astype(np.float32).ravel()
        self.seconds, self.nm = array("d"), array("f")
        twin.path_callbacks.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres."""
        self.seconds.append(time_s)
        path = opd.ravel()
        self.nm.append(
            1e9 * math.sqrt(float((path * path) @ self._weights) - float(path @ self._weights) ** 2)
        )


class WavefrontSampler:
    """Records a few wavefronts in front of the sensor from each of several times on."""

    def __init__(self, twin: SimBench, starts: NDArray[np.float64]) -> None:
        self.samples: list[list[tuple[float, NDArray[np.float32]]]] = []
        self._twin = twin
        self._sample_times = [
            float(start + k * WAVEFRONT_SPACING_S) for start in starts for k in range(WAVEFRONTS)
        ]
        twin.path_callbacks.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres of a frame."""
        if self._sample_times and time_s >= self._sample_times[0]:
            self._sample_times.pop(0)
            if not self.samples or len(self.samples[-1]) == WAVEFRONTS:
                self.samples.append([])
            self.samples[-1].append((time_s, self._twin.sensor_opd(opd, time_s)))


def matrix_at(bench: System, start: CalibrationResult, here: Registration) -> NDArray[np.float64]:
    """Initial matrix at another registration ``(n_slopes, n_modes)``, with the gain of every mode kept."""
    known, matrix, model = start.registration, start.matrix, bench.model(start.grid)
    assert known is not None
    then, now = (
        compute_fitted_matrix(model, where, known, matrix.m2c) for where in (known.registration, here)
    )
    return np.asarray(now * ((then * matrix.data).sum(axis=0) / np.square(then).sum(axis=0)))


def true_optical_gain(
    bench: System, twin: SimBench, result: CalibrationResult, wavefronts: list[tuple[float, Any]]
) -> float:
    """Mean optical gain around wavefronts by push-pull, relative to the start's matrix.

    The initial matrix is first moved to the true registration, so that the ratio contains the sensor's gain
    only and no misregistration.
    """
    m2c, slopes_of = result.matrix.m2c, build_slope_function(bench, result.grid)
    light = twin.wfs_light(bench.wfs.settings.exposure_s)
    unit = matrix_at(bench, result, twin.flexure.at(wavefronts[0][0]))
    gains = []
    for time_s, opd in wavefronts:
        for mode in np.linspace(0, m2c.shape[1] - 1, GAIN_MODES).astype(int):
            shape = twin.mirror_opd(GAIN_POKE * m2c[:, mode], time_s)
            slopes = []
            for sign in (1, -1):
                image = np.zeros(twin.wfs_detector.shape, np.float32)
                twin.sensor().frame(opd + sign * shape, image)
                # The camera's own frame: its black level and noise decide what the threshold cuts.
                frame, _ = twin.wfs_detector.expose(image, *light)
                slopes.append(slopes_of(frame).astype(float).copy())
            response = (slopes[0] - slopes[1]) / (2 * GAIN_POKE)
            gains.append(float(response @ unit[:, mode]) / float(unit[:, mode] @ unit[:, mode]))
    return float(np.mean(gains))


def run_tracker(options: argparse.Namespace) -> None:
    """Run the tracker and write its results with the true values."""
    result, psf = load_or_measure_start(options)
    with open_bench(options) as bench:
        twin = get_simulated_bench(bench)
        origin = twin.now_s
        ripples = WavefrontRms(twin)
        frozen = WavefrontSampler(
            twin, np.linspace(origin + 3, origin + options.seconds - 1, 2 * options.comparisons)
        )
        (options.out / "live.jsonl").unlink(missing_ok=True)
        found = bench.run(
            track(
                bench, result.matrix, result.grid, seconds=options.seconds, registration=result.registration,
                response=result.response, model_psf=psf, forgetting_time_s=options.memory, poke=options.poke,
            ),
            observers=(ProgressLog(options.out / "live.jsonl"),),
        )  # fmt: skip
        seconds = origin + found.column("seconds")
        truth = np.array([twin.flexure.at(t).to_array() for t in seconds])
        gains = [
            [near[0][0] - origin, true_optical_gain(bench, twin, result, near)] for near in frozen.samples
        ]
    document = {
        "origin": origin, "rows": found.rows, "truth": truth.tolist(), "gains": gains,
        "exchanges": sum(e.accepted for e in found.exchanges), "frames": found.frames,
        "alarms": [a.text for a in found.alarms], "poke": found.poke, "system": options.system,
    }  # fmt: skip
    (options.out / "track.json").write_text(json.dumps(document))
    np.savez(options.out / "ripples.npz", seconds=np.array(ripples.seconds) - origin, nm=ripples.nm)
    print(f"{found.frames} frames, {document['exchanges']} exchanges, alarms: {document['alarms']}")


class ProgressLog:
    """Writes the tracker's estimates of every second to a file, and every 20th to the terminal."""

    def __init__(self, path: Path) -> None:
        self._path, self._last = path, 0

    def __call__(self, progress: Progress) -> None:
        """Take a progress report."""
        if progress.stage != "tracking" or progress.done == self._last or not progress.metrics:
            return
        self._last = progress.done
        append_line(self._path, {"second": progress.done, **progress.metrics})
        if progress.done % 20 == 0:
            print(f"{progress.done} of {progress.total} s", flush=True)


def measure_strehl(
    bench: System, result: CalibrationResult, psf: Any, at_s: float, matrix: Any
) -> tuple[float, float]:
    """Strehl ratio of a loop closed for a few seconds at a time of the twin's clock; 0 if it diverges."""
    prepare_sensor(bench)
    bench.dm.flatten()
    get_simulated_bench(bench).advance_to(at_s - CLOSING_S)
    control = build_integrator(bench, matrix, result.grid)
    loop = RunningLoop(bench, matrix.m2c, build_slope_function(bench, result.grid), control, science=True)
    rate = bench.wfs.settings.frame_rate_hz
    bench.run(loop.run(round(CLOSING_S * rate)))
    loop.record.science = FrameStack()
    if not loop.record.diverged:
        bench.run(loop.run(round(COMPARISON_S * rate)))
    bench.dm.flatten()
    if loop.record.diverged:
        return 0.0, 0.0
    try:
        peak = strehl(loop.record.science.images(), psf).peak
    except CalibrationError as error:
        print(f"{at_s:.0f} s: {error}")
        return 0.0, 0.0
    return peak.value, peak.sigma


def compare(options: argparse.Namespace) -> None:
    """Strehl ratios of a loop with the true registration or with its first matrix, at intervals."""
    tracked = json.loads((options.out / "track.json").read_text())
    result, psf = load_or_measure_start(options)
    gains = np.array(tracked["gains"])
    done = read_comparison(options.out, options.loop)
    with open_bench(options) as bench:
        twin = get_simulated_bench(bench)
        for end in comparison_times(tracked, options.comparisons):
            if any(abs(end - one[0]) < COMPARISON_S for one in done):
                continue
            at, matrix = tracked["origin"] + end - COMPARISON_S, result.matrix
            if options.loop == "true":
                gain = float(np.interp(end, *gains.T))
                data = gain * matrix_at(bench, result, twin.flexure.at(at + COMPARISON_S / 2))
                matrix = replace(matrix, data=data.astype(np.float32))
            one = [float(end), *measure_strehl(bench, result, psf, at, matrix)]
            append_line(options.out / f"{options.loop}.jsonl", one)
            print(options.loop, *(f"{value:.4f}" for value in one), flush=True)


def comparison_times(tracked: dict[str, Any], comparisons: int) -> NDArray[np.float64]:
    """Ends of the intervals of the other loops: those of the tracker's Strehl ratios."""
    rows = {name: np.array(tracked["rows"][name], float) for name in ("seconds", "strehl")}
    # A ratio uses the science frames of the five preceding updates.
    ends = rows["seconds"][np.isfinite(rows["strehl"])][1:]
    # At least two rows apart: an interval includes the time to close the loop.
    return np.asarray(ends[:: max(2, len(ends) // comparisons)])


def main() -> None:
    """Run ``track``, ``compare`` or ``draw``."""
    parser = study_parser(__doc__, "razor-shwfs")
    parser.add_argument("what", choices=["track", "compare", "draw"])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument(
        "--drift", type=float, default=20.0, help="shift x over the run, %% of a sub-aperture"
    )
    parser.add_argument("--swing", type=float, default=0.0, help="swing of the rotation, degrees")
    parser.add_argument("--seeing", type=float, default=0.2, help="swing of r0, fraction")
    parser.add_argument("--memory", type=float, default=10.0)
    parser.add_argument("--poke", type=float, default=None, help="as configured by default")
    parser.add_argument("--frames", type=int, default=2000, help="frames of the initial calibration")
    parser.add_argument("--comparisons", type=int, default=24, help="intervals of each of the other loops")
    parser.add_argument("--loop", choices=list(LABELS), default="true", help="loop of compare")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--figure", type=Path, default=Path("tracking.png"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "draw":
        draw(options.out, options.figure)
    else:
        {"track": run_tracker, "compare": compare}[options.what](options)


if __name__ == "__main__":
    main()
