"""A drifting bench followed by the tracker, beside a loop that knows the truth and one that never looks.

    python benchmarks/tracking.py track --seconds 600 --out tracked
    python benchmarks/tracking.py compare --loop knows --out tracked
    python benchmarks/tracking.py compare --loop never --out tracked
    python benchmarks/tracking.py draw --out tracked --figure docs/figures/tracking.png

``track`` calibrates, on a pyramid finds the optical gains, and runs the tracker once, all frames; it keeps
its table with the twin's truth beside it. ``compare`` closes another loop for a few seconds at a time, at
the same moments of the same turbulence, without pokes: with the matrix moved to the true registration and
scaled to the true gain, or with the matrix of the start. ``draw`` puts them together and says how far they
are apart. Each takes the same options.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.found_mirror import found_matrix
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor
from escape_hw.calibration.track import track
from escape_hw.errors import CalibrationError
from escape_hw.io.fits import load_matrix, save_matrix
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.strehl import strehl
from escape_hw.report import style
from escape_hw.runtime.system import System, open_system
from escape_sim.sim_bench import SimBench

#: Seconds of a look at the other loops, and how long they close before.
LOOK_S, CLOSE_S = 5.0, 1.0
#: Modes and wavefronts that the true optical gain is found on; size of the poke in strokes.
GAIN_MODES, WAVEFRONTS, GAIN_POKE = 12, 4, 3e-3
#: Seconds from one of those wavefronts to the next; seconds of tracking that are not judged.
APART_S, SETTLED_S = 0.4, 10.0
LABELS = {"knows": "knows the truth, no pokes", "never": "never looks, no pokes"}


def drift_words(options: argparse.Namespace) -> list[str]:
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


def opened(options: argparse.Namespace) -> System:
    """The bench, drifting, with its streams of random numbers at their beginning."""
    return open_system(options.system, set=drift_words(options), seed=options.seed)


def prepared(options: argparse.Namespace) -> tuple[CalibrationResult, NDArray[np.float32]]:
    """The calibration to start from and the model PSF, made on a bench that does not drift, once."""
    matrix, image = options.out / "start.fits", options.out / "psf.npy"
    if not matrix.exists():
        with open_system(options.system, set=options.set, seed=options.seed) as bench:
            result = bench.calibrate(frames=options.frames)
            np.save(image, bench.take_model_psf(frames=10))
            if bench.config.sensor.kind == "pyramid":
                result = bench.find_optical_gains(result, accuracy=0.05, frames=2000).rescaled
            save_matrix(matrix, result)
    return load_matrix(matrix).result, np.load(image)


def twin_of(bench: System) -> SimBench:
    """The simulated bench behind a system."""
    twin = getattr(bench.dm, "twin", None)
    if not isinstance(twin, SimBench):
        raise SystemExit(f"{bench.config.system.name} has no twin with a truth to look at")
    return twin


class Wavefronts:
    """Keeps a few wavefronts in front of the sensor from certain moments on, by time."""

    def __init__(self, twin: SimBench, starts: NDArray[np.float64]) -> None:
        self.kept: list[list[tuple[float, NDArray[np.float32]]]] = []
        self._twin = twin
        self._moments = [float(start + k * APART_S) for start in starts for k in range(WAVEFRONTS)]
        twin.onlookers.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres of a frame."""
        if self._moments and time_s >= self._moments[0]:
            self._moments.pop(0)
            if not self.kept or len(self.kept[-1]) == WAVEFRONTS:
                self.kept.append([])
            self.kept[-1].append((time_s, self._twin.sensor_path(opd, time_s)))


def moved_to(bench: System, start: CalibrationResult, here: Registration) -> NDArray[np.float64]:
    """The start's matrix moved to a registration ``(n_slopes, n_modes)``, each mode as strong as it was."""
    known, matrix, model = start.registration, start.matrix, bench.model(start.grid)
    assert known is not None
    then, now = (
        found_matrix(model, where, known, matrix.m2c) for where in (known.registration, here)
    )
    return np.asarray(now * ((then * matrix.data).sum(axis=0) / np.square(then).sum(axis=0)))


def true_gain(
    bench: System, twin: SimBench, result: CalibrationResult, wavefronts: list[tuple[float, Any]]
) -> float:
    """Mean optical gain around wavefronts by push-pull, relative to the start's matrix.

    The start's matrix is moved to the true registration of the moment first: what is wanted is how much
    weaker the sensor answers, not where the mirror sits.
    """
    m2c, slopes_of = result.matrix.m2c, extractor(bench, result.grid)
    light = twin.wfs_light(bench.wfs.settings.exposure_s)
    unit = moved_to(bench, result, twin.flexure.at(wavefronts[0][0]))
    shares = []
    for time_s, opd in wavefronts:
        for mode in np.linspace(0, m2c.shape[1] - 1, GAIN_MODES).astype(int):
            shape = twin.mirror_path(GAIN_POKE * m2c[:, mode], time_s)
            slopes = []
            for sign in (1, -1):
                image = np.zeros(twin.wfs_detector.shape, np.float32)
                twin.sensor().frame(opd + sign * shape, image)
                # The camera's own frame: its black level and noise decide what the threshold cuts.
                frame, _ = twin.wfs_detector.expose(image, *light)
                slopes.append(slopes_of(frame).astype(float).copy())
            answer = (slopes[0] - slopes[1]) / (2 * GAIN_POKE)
            shares.append(float(answer @ unit[:, mode]) / float(unit[:, mode] @ unit[:, mode]))
    return float(np.mean(shares))


def follow(options: argparse.Namespace) -> None:
    """Run the tracker and write what it said beside the truth."""
    result, psf = prepared(options)
    with opened(options) as bench:
        twin = twin_of(bench)
        origin = twin.now_s
        frozen = Wavefronts(twin, np.linspace(origin + 3, origin + options.seconds - 1, 2 * options.looks))
        found = bench.run(
            track(
                bench, result.matrix, result.grid, seconds=options.seconds, registration=result.registration,
                response=result.response, model_psf=psf, memory_s=options.memory, poke=options.poke,
            ),
            observers=(tell,),
        )  # fmt: skip
        seconds = origin + found.column("seconds")
        truth = np.array([twin.flexure.at(t).to_array() for t in seconds])
        gains = [[near[0][0] - origin, true_gain(bench, twin, result, near)] for near in frozen.kept]
    document = {
        "origin": origin, "rows": found.rows, "truth": truth.tolist(), "gains": gains,
        "exchanges": sum(e.accepted for e in found.exchanges), "frames": found.frames,
        "alarms": [a.text for a in found.alarms], "poke": found.poke, "system": options.system,
    }  # fmt: skip
    (options.out / "track.json").write_text(json.dumps(document))
    print(f"{found.frames} frames, {document['exchanges']} exchanges, alarms: {document['alarms']}")


def tell(progress: Any) -> None:
    """Print how far the tracker is."""
    if progress.stage == "tracking" and progress.done % 20 == 0 and progress.metrics:
        print(f"\r{progress.done} of {progress.total} s", end="", flush=True)


def look(bench: System, result: CalibrationResult, psf: Any, at_s: float, matrix: Any) -> tuple[float, float]:
    """Strehl ratio of a loop closed for a few seconds at a moment of the twin's clock; 0 where it is lost."""
    prepare_sensor(bench)
    bench.dm.flatten()
    twin_of(bench).advance_to(at_s - CLOSE_S)
    control = integrator_for(bench, matrix, result.grid)
    loop = RunningLoop(bench, matrix.m2c, extractor(bench, result.grid), control, science=True)
    rate = bench.wfs.settings.frame_rate_hz
    bench.run(loop.run(round(CLOSE_S * rate)))
    loop.record.science = FrameStack()
    if not loop.record.diverged:
        bench.run(loop.run(round(LOOK_S * rate)))
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
    """Strehl ratios of a loop that knows or that never looks, now and then."""
    tracked = json.loads((options.out / "track.json").read_text())
    result, psf = prepared(options)
    gains = np.array(tracked["gains"])
    looks = []
    with opened(options) as bench:
        twin = twin_of(bench)
        for end in moments(tracked, options.looks):
            at, matrix = tracked["origin"] + end - LOOK_S, result.matrix
            if options.loop == "knows":
                gain = float(np.interp(end, *gains.T))
                data = gain * moved_to(bench, result, twin.flexure.at(at + LOOK_S / 2))
                matrix = replace(matrix, data=data.astype(np.float32))
            looks.append([end, *look(bench, result, psf, at, matrix)])
            print(options.loop, *(f"{value:.4f}" for value in looks[-1]), flush=True)
    (options.out / f"{options.loop}.json").write_text(json.dumps(looks))


def moments(tracked: dict[str, Any], looks: int) -> NDArray[np.float64]:
    """When the looks at the other loops end: where the tracker's Strehl ratios do."""
    rows = {name: np.array(tracked["rows"][name], float) for name in ("seconds", "strehl")}
    # A ratio holds the science frames of the five updates before.
    ends = rows["seconds"][np.isfinite(rows["strehl"])][1:]
    # Two rows apart at least: a look takes longer than the time that it covers.
    return np.asarray(ends[:: max(2, len(ends) // looks)])


def draw(options: argparse.Namespace) -> None:
    """Errors in numbers, and the figure."""
    tracked = json.loads((options.out / "track.json").read_text())
    rows = {name: np.array(values, float) for name, values in tracked["rows"].items()}
    truth, t = np.array(tracked["truth"]), rows["seconds"]
    settled = t > SETTLED_S
    for k, name in enumerate(PARAMETERS):
        error = (rows[name] - truth[:, k])[settled]
        chi2 = np.mean(np.square(error / rows[f"{name}_sigma"][settled]))
        rms, worst = np.sqrt(np.mean(error**2)), np.abs(error).max()
        print(f"{name}: rms error {rms:.4f}, largest {worst:.4f}, chi2 {chi2:.2f}")
    gains = np.array(tracked["gains"])
    gains = gains[gains[:, 0] > SETTLED_S]
    share = np.interp(gains[:, 0], t, rows["optical_gain"]) / gains[:, 1] - 1
    print(f"optical gain: mean error {share.mean():+.4f}, rms {np.sqrt(np.mean(share**2)):.4f},", end=" ")
    print(f"largest {np.abs(share).max():.4f}; true {gains[:, 1].min():.3f} to {gains[:, 1].max():.3f}")
    others = {}
    for loop in ("knows", "never"):
        path = options.out / f"{loop}.json"
        if path.exists():
            others[loop] = np.array(json.loads(path.read_text()))
            print(difference(loop, others[loop], t, rows["strehl"]))
    picture(rows, truth, gains, others).savefig(options.figure, dpi=110)


def difference(loop: str, looks: NDArray[np.float64], t: Any, ratios: Any) -> str:
    """Mean Strehl ratios of the tracked loop and another one at the same moments, and of their difference."""
    here = np.array([ratios[np.argmin(np.abs(t - end))] for end in looks[:, 0]])
    apart = here - looks[:, 1]
    error = apart.std(ddof=1) / np.sqrt(len(apart))
    return (
        f"Strehl ratio: tracked {100 * here.mean():.2f} %, {loop} {100 * looks[:, 1].mean():.2f} %, tracked "
        f"minus {loop} {100 * apart.mean():+.2f} +- {100 * error:.2f} % ({len(apart)} looks), "
        f"last quarter {100 * apart[-len(apart) // 4 :].mean():+.2f} %"
    )


def picture(rows: dict[str, Any], truth: Any, gains: Any, others: dict[str, Any]) -> Figure:
    """Shift, rotation, gain and Strehl ratio against time."""
    figure = style.new_figure(9.2, 6.4)
    panels = figure.subplots(2, 2).ravel()
    t = rows["seconds"]
    for panel, name, k, title in (
        (panels[0], "shift_x", 0, "shift x [% of a sub-aperture]"),
        (panels[1], "rotation", 2, "rotation [deg]"),
    ):
        value, sigma = rows[name] - truth[0, k], rows[f"{name}_sigma"]
        panel.fill_between(t, value - sigma, value + sigma, color=style.SERIES[0], alpha=0.3, lw=0)
        panel.plot(t, value, color=style.SERIES[0], lw=1.2, label="tracked")
        panel.plot(t, truth[:, k] - truth[0, k], ":", color=style.INK, lw=1.2, label="truth")
        style.tidy(panel).set_title(f"{title}, since the start", fontsize=9.5)
    sigma = rows["optical_gain_sigma"]
    panels[2].fill_between(
        t, rows["optical_gain"] - sigma, rows["optical_gain"] + sigma, color=style.SERIES[0], alpha=0.3, lw=0
    )
    panels[2].plot(t, rows["optical_gain"], color=style.SERIES[0], lw=1.2, label="tracked")
    panels[2].plot(gains[:, 0], gains[:, 1], "o", ms=3, color=style.INK, label="truth")
    style.tidy(panels[2]).set_title("optical gain, beside the start's matrix", fontsize=9.5)
    ratio = np.isfinite(rows["strehl"])
    panels[3].errorbar(
        t[ratio], rows["strehl"][ratio], rows["strehl_sigma"][ratio],
        color=style.SERIES[0], lw=1.0, elinewidth=0.5, label="tracked, with pokes",
    )  # fmt: skip
    for (loop, looks), mark, colour in zip(others.items(), "os", (style.INK, style.SERIES[1]), strict=False):
        panels[3].plot(looks[:, 0], looks[:, 1], mark, ms=3.5, color=colour, label=LABELS[loop])
    style.tidy(panels[3]).set_title("Strehl ratio, peak", fontsize=9.5)
    for panel in panels:
        panel.set_xlabel("seconds")
        panel.legend(frameon=False, fontsize=8)
    return figure


def main() -> None:
    """Parse, and do one of the three."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["track", "compare", "draw"])
    parser.add_argument("--system", default="razor-shwfs")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument(
        "--drift", type=float, default=20.0, help="shift x over the run, %% of a sub-aperture"
    )
    parser.add_argument("--swing", type=float, default=0.0, help="swing of the rotation, degrees")
    parser.add_argument("--seeing", type=float, default=0.2, help="swing of r0, fraction")
    parser.add_argument("--memory", type=float, default=10.0)
    parser.add_argument("--poke", type=float, default=None, help="as configured by default")
    parser.add_argument("--frames", type=int, default=2000, help="frames of the calibration before")
    parser.add_argument("--looks", type=int, default=24, help="how often the other loops are closed")
    parser.add_argument("--loop", choices=["knows", "never"], default="knows", help="what compare closes")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--figure", type=Path, default=Path("tracking.png"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    {"track": follow, "compare": compare, "draw": draw}[options.what](options)


if __name__ == "__main__":
    main()
