"""A drifting bench followed by the tracker, beside a loop that knows the truth and one that never looks.

    python benchmarks/tracking.py track --seconds 600 --out tracked
    python benchmarks/tracking.py compare --loop knows --out tracked
    python benchmarks/tracking.py compare --loop never --out tracked
    python benchmarks/tracking.py draw --out tracked --figure docs/figures/tracking.png

``track`` calibrates, on a pyramid finds the optical gains, and runs the tracker once, all frames; it keeps
its table with the twin's truth beside it (``track.json``; ``live.jsonl`` while it runs). ``compare`` closes
another loop for a few seconds at a time, at the same moments of the same turbulence, without pokes: with the
matrix moved to the true registration and scaled to the true gain, or with the matrix of the start; looks
that its file has already are not repeated. ``draw`` puts them together and says how far they are apart. Each
takes the same options.
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
from numpy.typing import NDArray
from tracking_figure import draw, looked

from escape_hw.api.procedure import Progress
from escape_hw.api.registration import Registration
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
from escape_hw.runtime.system import System, open_system
from escape_sim.sim_bench import SimBench

#: Seconds of a look at the other loops, and how long they close before.
LOOK_S, CLOSE_S = 5.0, 1.0
#: Modes and wavefronts that the true optical gain is found on; size of the poke in strokes.
GAIN_MODES, WAVEFRONTS, GAIN_POKE = 12, 4, 3e-3
#: Seconds from one of those wavefronts to the next.
APART_S = 0.4


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


class Ripples:
    """Keeps the rms of the wavefront in front of the sensor, mirror included, of every moment it is seen."""

    def __init__(self, twin: SimBench) -> None:
        self._share = (twin.pupil.lit / np.count_nonzero(twin.pupil.lit)).astype(np.float32).ravel()
        self.seconds, self.nm = array("d"), array("f")
        twin.onlookers.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Take the optical path ``(n, n)`` in metres."""
        self.seconds.append(time_s)
        path = opd.ravel()
        self.nm.append(1e9 * math.sqrt(float((path * path) @ self._share) - float(path @ self._share) ** 2))


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
    then, now = (found_matrix(model, where, known, matrix.m2c) for where in (known.registration, here))
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
        ripples = Ripples(twin)
        frozen = Wavefronts(twin, np.linspace(origin + 3, origin + options.seconds - 1, 2 * options.looks))
        (options.out / "live.jsonl").unlink(missing_ok=True)
        found = bench.run(
            track(
                bench, result.matrix, result.grid, seconds=options.seconds, registration=result.registration,
                response=result.response, model_psf=psf, memory_s=options.memory, poke=options.poke,
            ),
            observers=(Journal(options.out / "live.jsonl"),),
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
    np.savez(options.out / "ripples.npz", seconds=np.array(ripples.seconds) - origin, nm=ripples.nm)
    print(f"{found.frames} frames, {document['exchanges']} exchanges, alarms: {document['alarms']}")


class Journal:
    """Writes what the tracker tells every second to a file, and now and then to the terminal."""

    def __init__(self, path: Path) -> None:
        self._path, self._last = path, 0

    def __call__(self, progress: Progress) -> None:
        """Take a progress report."""
        if progress.stage != "tracking" or progress.done == self._last or not progress.metrics:
            return
        self._last = progress.done
        with self._path.open("a") as lines:
            lines.write(json.dumps({"second": progress.done, **progress.metrics}) + "\n")
        if progress.done % 20 == 0:
            print(f"{progress.done} of {progress.total} s", flush=True)


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
    done = looked(options.out, options.loop)
    with opened(options) as bench:
        twin = twin_of(bench)
        for end in moments(tracked, options.looks):
            if any(abs(end - one[0]) < LOOK_S for one in done):
                continue
            at, matrix = tracked["origin"] + end - LOOK_S, result.matrix
            if options.loop == "knows":
                gain = float(np.interp(end, *gains.T))
                data = gain * moved_to(bench, result, twin.flexure.at(at + LOOK_S / 2))
                matrix = replace(matrix, data=data.astype(np.float32))
            one = [float(end), *look(bench, result, psf, at, matrix)]
            with (options.out / f"{options.loop}.jsonl").open("a") as lines:
                lines.write(json.dumps(one) + "\n")
            print(options.loop, *(f"{value:.4f}" for value in one), flush=True)


def moments(tracked: dict[str, Any], looks: int) -> NDArray[np.float64]:
    """When the looks at the other loops end: where the tracker's Strehl ratios do."""
    rows = {name: np.array(tracked["rows"][name], float) for name in ("seconds", "strehl")}
    # A ratio holds the science frames of the five updates before.
    ends = rows["seconds"][np.isfinite(rows["strehl"])][1:]
    # Two rows apart at least: a look takes longer than the time that it covers.
    return np.asarray(ends[:: max(2, len(ends) // looks)])


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
    if options.what == "draw":
        draw(options.out, options.figure)
    else:
        {"track": follow, "compare": compare}[options.what](options)


if __name__ == "__main__":
    main()
