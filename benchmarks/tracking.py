"""A drifting bench followed by the tracker, beside a loop that knows the truth and one that never looks.

    python benchmarks/tracking.py track --seconds 600 --out tracked
    python benchmarks/tracking.py compare --out tracked
    python benchmarks/tracking.py draw --out tracked --figure docs/figures/tracking.png

``track`` runs the tracker once, all frames, and keeps its table with the twin's truth beside it.
``compare`` closes the loop for a few seconds at a time, at the same moments of the same turbulence, with
the matrix of the true registration and with the matrix of the start. ``draw`` puts both together.
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

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.pseudo_synthetic import pseudo_synthetic
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor
from escape_hw.calibration.track import track
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.strehl import strehl
from escape_hw.report import style
from escape_hw.runtime.system import System, open_system
from escape_sim.sim_bench import SimBench

#: Seconds of a look at the other loops, and how long they close before.
LOOK_S, CLOSE_S = 5.0, 1.0
#: Modes and wavefronts that the true optical gain is found on; size of the poke in strokes.
GAIN_MODES, WAVEFRONTS, GAIN_POKE = 12, 4, 1e-3


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


def started(options: argparse.Namespace) -> tuple[System, CalibrationResult, NDArray[np.float32], SimBench]:
    """The bench calibrated, its model PSF, and the twin behind it; the same at every call."""
    bench = open_system(options.system, set=drift_words(options), seed=options.seed)
    result = bench.calibrate(frames=options.frames)
    psf = bench.take_model_psf(frames=10)
    return bench, result, psf, twin_of(bench)


def twin_of(bench: System) -> SimBench:
    """The simulated bench behind a system."""
    twin = getattr(bench.dm, "twin", None)
    if not isinstance(twin, SimBench):
        raise SystemExit(f"{bench.config.system.name} has no twin with a truth to look at")
    return twin


class Wavefronts:
    """Keeps what the sensor saw now and then, by time."""

    def __init__(self, twin: SimBench, every_s: float) -> None:
        self.kept: list[tuple[float, NDArray[np.float32]]] = []
        self._twin, self._every, self._next = twin, every_s, 0.0
        twin.onlookers.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres of a frame."""
        if time_s >= self._next:
            self.kept.append((time_s, self._twin.sensor_path(opd, time_s)))
            self._next = time_s + self._every


def true_gain(
    bench: System, twin: SimBench, result: CalibrationResult, wavefronts: list[tuple[float, Any]]
) -> float:
    """Mean optical gain around wavefronts, noise-free push-pull, relative to the start's matrix.

    The start's matrix is moved to the true registration of the moment first: what is wanted is how much
    weaker the sensor answers, not where the mirror sits.
    """
    model, m2c, slopes_of = bench.model(result.grid), result.matrix.m2c, extractor(bench, result.grid)
    start = result.registration
    assert start is not None
    counts = 0.7 * 2**bench.config.devices.wfs.bit_depth
    shares = []
    for time_s, opd in wavefronts:
        here = twin.flexure.at(time_s)
        unit = start.gain.value * modal_matrix(model, here, m2c, start.width.value)
        for mode in np.linspace(0, m2c.shape[1] - 1, GAIN_MODES).astype(int):
            shape = twin.mirror_path(GAIN_POKE * m2c[:, mode], time_s)
            slopes = []
            for sign in (1, -1):
                image = np.zeros(twin.wfs_detector.shape, np.float32)
                twin.sensor().frame(opd + sign * shape, image)
                # The same exposure for both: what the brightest pixel gets depends on the wavefront.
                slopes.append(slopes_of(image * (counts / image.max())).astype(float).copy())
            answer = (slopes[0] - slopes[1]) / (2 * GAIN_POKE)
            shares.append(float(answer @ unit[:, mode]) / float(unit[:, mode] @ unit[:, mode]))
    return float(np.mean(shares))


def follow(options: argparse.Namespace) -> None:
    """Run the tracker and write what it said beside the truth."""
    bench, result, psf, twin = started(options)
    with bench:
        frozen = Wavefronts(twin, 0.4)
        origin = twin.now_s
        found = bench.run(
            track(
                bench, result.matrix, result.grid, seconds=options.seconds, registration=result.registration,
                response=result.response, model_psf=psf, memory_s=options.memory, poke=options.poke,
            ),
            observers=(_tell,),
        )  # fmt: skip
        seconds = origin + found.column("seconds")
        truth = np.array([twin.flexure.at(t).to_array() for t in seconds])
        gains = []
        for start in np.linspace(origin + 2, origin + options.seconds, 2 * options.looks):
            near = [one for one in frozen.kept if start <= one[0] < start + 4 * 0.4 + 0.2][:WAVEFRONTS]
            if near:
                gains.append([near[0][0] - origin, true_gain(bench, twin, result, near)])
    document = {
        "origin": origin, "rows": found.rows, "truth": truth.tolist(), "gains": gains,
        "exchanges": sum(e.accepted for e in found.exchanges), "frames": found.frames,
        "alarms": [a.text for a in found.alarms], "poke": found.poke, "system": options.system,
    }  # fmt: skip
    (options.out / "track.json").write_text(json.dumps(document))
    print(f"{found.frames} frames, {document['exchanges']} exchanges, alarms: {document['alarms']}")


def _tell(progress: Any) -> None:
    if progress.stage == "tracking" and progress.done % 20 == 0 and progress.metrics:
        print(f"\r{progress.done} of {progress.total} s", end="", flush=True)


def look(bench: System, result: CalibrationResult, psf: Any, at_s: float, matrix: Any) -> tuple[float, float]:
    """Strehl ratio of a loop closed for a few seconds at a moment of the twin's clock."""
    twin = twin_of(bench)
    prepare_sensor(bench)
    bench.dm.flatten()
    twin.advance_to(at_s - CLOSE_S)
    control = integrator_for(bench, matrix, result.grid)
    loop = RunningLoop(bench, matrix.m2c, extractor(bench, result.grid), control, science=True)
    rate = bench.wfs.settings.frame_rate_hz
    bench.run(loop.run(round(CLOSE_S * rate)))
    loop.record.science = FrameStack()
    bench.run(loop.run(round(LOOK_S * rate)))
    bench.dm.flatten()
    peak = strehl(loop.record.science.images(), psf).peak
    return peak.value, peak.sigma


def compare(options: argparse.Namespace) -> None:
    """Strehl ratios of the loop that knows and of the one that never looks, now and then.

    Each on a bench of its own, so that both meet the same turbulence at the same time as the tracker did.
    """
    tracked = json.loads((options.out / "track.json").read_text())
    rows = {name: np.array(tracked["rows"][name], float) for name in ("seconds", "strehl")}
    # A ratio holds the science frames of the five updates before.
    ends = rows["seconds"][np.isfinite(rows["strehl"])][1:]
    # Two rows apart at least: a look takes longer than the time that it covers.
    ends = ends[:: max(2, len(ends) // options.looks)]
    looks = [[end - LOOK_S] for end in ends]
    for knows in (True, False):
        bench, result, psf, twin = started(options)
        with bench:
            for one in looks:
                at = tracked["origin"] + one[0]
                matrix = at_truth(bench, result, twin.flexure.at(at + LOOK_S / 2)) if knows else result.matrix
                one += look(bench, result, psf, at, matrix)
                print("knows" if knows else "never", *(f"{v:.4f}" for v in one), flush=True)
    (options.out / "compare.json").write_text(json.dumps(looks))


def at_truth(bench: System, result: CalibrationResult, here: Registration) -> InteractionMatrix:
    """The start's matrix moved to a registration."""
    start = result.registration
    assert start is not None
    moved = replace(start, registration=here)
    data, _ = pseudo_synthetic(bench.model(result.grid), moved, result.matrix.m2c)
    return replace(result.matrix, data=data.astype(np.float32))


def draw(options: argparse.Namespace) -> None:
    """Errors in numbers, and the figure."""
    tracked = json.loads((options.out / "track.json").read_text())
    others = options.out / "compare.json"
    looks = np.array(json.loads(others.read_text())) if others.exists() else None
    rows = {name: np.array(values, float) for name, values in tracked["rows"].items()}
    truth, t = np.array(tracked["truth"]), rows["seconds"]
    settled = t > 10
    for k, name in enumerate(PARAMETERS):
        error = (rows[name] - truth[:, k])[settled]
        chi2 = np.mean(np.square(error / rows[f"{name}_sigma"][settled]))
        rms, worst = np.sqrt(np.mean(error**2)), np.abs(error).max()
        print(f"{name}: rms error {rms:.4f}, worst {worst:.4f}, chi2 {chi2:.2f}")
    gains = np.array(tracked["gains"])
    said = np.interp(gains[:, 0], t, rows["optical_gain"])
    rms = np.sqrt(np.mean(np.square(said - gains[:, 1])))
    print(f"optical gain: rms error {rms:.4f} of {gains[:, 1].mean():.3f}")
    ratio = np.isfinite(rows["strehl"]) & settled
    if looks is not None:
        here = np.interp(looks[:, 0] + LOOK_S, t[ratio], rows["strehl"][ratio])
        knows, never = looks[:, 1].mean(), looks[:, 3].mean()
        print(f"Strehl: tracked {here.mean():.4f}, knows {knows:.4f}, never {never:.4f}")
    figure = picture(rows, truth, gains, looks, ratio)
    figure.savefig(options.figure, dpi=110)


def picture(rows: dict[str, Any], truth: Any, gains: Any, looks: Any, ratio: Any) -> Figure:
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
    panels[3].plot(t[ratio], rows["strehl"][ratio], color=style.SERIES[0], lw=1.0, label="tracked")
    if looks is not None:
        panels[3].errorbar(
            looks[:, 0], looks[:, 1], looks[:, 2], fmt="o", ms=3, color=style.INK, label="knows the truth"
        )
        panels[3].errorbar(
            looks[:, 0], looks[:, 3], looks[:, 4], fmt="s", ms=3, color=style.SERIES[1], label="never looks"
        )
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
    parser.add_argument("--looks", type=int, default=11, help="how often the other loops are closed")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--figure", type=Path, default=Path("tracking.png"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    {"track": follow, "compare": compare, "draw": draw}[options.what](options)


if __name__ == "__main__":
    main()
