"""Strehl ratios on equal turbulence of ESCAPE, DO-CRIME and push-pull (the baseline), and registrations.

    python benchmarks/studies/loops/loop_comparison.py --seeds 1 2 3 4 5 6 7 8 9 10 --out paired
    python benchmarks/studies/loops/loop_comparison.py --system revolt-shwfs --seeds 1 2 3 4 5 --short 1000 \\
        --calibration 4000 --set loop.gain=0.7 --out paired --table docs/studies/paired-loops
    python benchmarks/studies/loops/loop_comparison.py --system maps-nir --no-gains --no-baseline \\
        --out paired --table docs/studies/paired-loops

Each seed is a twin with a mirror and turbulence of its own. Every matrix is closed at its own best gain,
found on the first seconds of that turbulence with a margin: the gain whose Strehl ratio is highest also if
it were larger by a fifth, since a loop at the limit of stability does not outlast the turbulence that it was
found on. It is evaluated on later turbulence, the same for all. On a pyramid the matrices of ESCAPE and
DO-CRIME are scaled by their optical gains (``+ OG``); DO-CRIME's is also closed as measured. With
``--no-gains`` both are as calibrated. Matrices and loops are saved in a folder and are not repeated; with
``--minutes 4`` nothing new is started after four minutes, and the next call continues. Prints the table of
the finished seeds, with the differences paired by seed and their two-sided 95 % intervals (Student's t).
``--table`` is the folder of the raw table (``SYSTEM-NAME.jsonl``, a line per seed) and of the page made from
it (``SYSTEM-NAME.md``). A seed of the pyramid bench takes some six minutes on an idle core.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import Line, append_line, each_realisation, read_lines, study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, UNITS
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.loop.runner import minimum_strehl_frames
from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
from escape_hw.calibration.optical_gain.matrix_comparison import projector, scale_matrix, slope_weights
from escape_hw.calibration.optical_gain.smoothing import clip_gains
from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix
from escape_hw.config.loader import load_system
from escape_hw.config.sensor import PyramidSection
from escape_hw.errors import CalibrationError
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.provenance import get_git_state
from escape_hw.pipeline.statistics import mean_interval
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import get_simulated_bench

ESCAPE, BASELINE, DOCRIME, GAINS = "ESCAPE", "push-pull", "DO-CRIME", " + OG"
#: Each is compared with those after it.
PAIRED = (ESCAPE + GAINS, ESCAPE, DOCRIME + GAINS, DOCRIME, BASELINE)
#: Start times of evaluated loops and bootstrap on the twin's clock, each after the previous turbulence.
EVALUATION_START_S, BOOTSTRAP_START_S = 4.0, 10.0
#: Gains tried, relative to the usual one in effect; while the best is at an end, further ones by this ratio,
#: which is the margin as well.
FACTORS, RATIO, MAX_FURTHER = (0.85, 1.0, 1.2), 1.2, 6


class TimeBudgetExceeded(Exception):
    """No new measurement may start."""


class SeedRun:
    """One twin: its matrices and loops, saved in a folder.

    Parameters
    ----------
    options
        The command line.
    number
        The seed.
    until
        Time of the monotonic clock after which nothing is started.
    """

    def __init__(self, options: argparse.Namespace, number: int, until: float) -> None:
        self.options, self.number, self._until = options, number, until
        self._folder = options.out / f"{options.system}-{number}"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lines = self._folder / "loops.jsonl"
        self._records: dict[str, dict[str, Any]] = {row["what"]: row for row in read_lines(self._lines)}

    def open_bench(self) -> System:
        """Open a bench in its initial state, so that results do not depend on earlier measurements."""
        if time.monotonic() > self._until:
            raise TimeBudgetExceeded
        return open_system(self.options.system, seed=self.number, set=self.options.set)

    def matrix(self, name: str, make: Callable[[System], CalibrationResult]) -> CalibrationResult:
        """A matrix, measured unless it is saved already."""
        if not self._path(name).exists():
            with self.open_bench() as bench:
                self.save_matrix(name, make(bench), bench)
        return load_matrix(self._path(name)).result

    def save_matrix(self, name: str, result: CalibrationResult, bench: System) -> None:
        """Save a matrix that was measured beside another."""
        save_matrix(self._path(name), result, BenchRecord.from_bench(bench).origin())

    def _path(self, name: str) -> Path:
        return Path(self._folder, f"{name}.fits")

    def model_psf(self) -> NDArray[np.float32]:
        """The image without turbulence."""
        path = self._folder / "model_psf.npy"
        if not path.exists():
            with self.open_bench() as bench:
                np.save(path, bench.take_model_psf(frames=5))
        return np.asarray(np.load(path))

    def get_or_measure(self, what: str, make: Callable[[System], dict[str, Any]]) -> dict[str, Any]:
        """A record, measured unless it is saved already."""
        if what not in self._records:
            with self.open_bench() as bench:
                self.add_record(what, make(bench))
        return self._records[what]

    def add_record(self, what: str, found: dict[str, Any]) -> None:
        """Save a record."""
        self._records[what] = {"what": what, **found}
        append_line(self._lines, self._records[what])
        print(f"seed {self.number}: {json.dumps(self._records[what])}", flush=True)


def every_mode_is_measured(matrix: InteractionMatrix) -> bool:
    """Whether every mode of a matrix is above its noise."""
    try:
        projector(matrix, slope_weights(matrix))
    except CalibrationError:
        return False
    return True


def scaled_by_optical_gains(seed: SeedRun, escape: CalibrationResult) -> dict[str, CalibrationResult]:
    """ESCAPE's matrix and DO-CRIME's, each scaled by its optical gains as the bootstrap finds them.

    Without DO-CRIME's where a mode of it is noise, so that it has no optical gain.
    """
    options, measured = seed.options, escape.measured
    assert measured is not None
    others = {DOCRIME: measured} if every_mode_is_measured(measured) else {}

    def rescaled_matrix(bench: System) -> CalibrationResult:
        get_simulated_bench(bench).advance_to(BOOTSTRAP_START_S)
        run = bench.run(
            bootstrap_gains(
                bench,
                escape,
                frames=options.frames,
                accuracy=options.accuracy,
                comparisons=others,
                closed_loop_matrix=static_light_matrix(bench, escape),
            )
        )
        result = run.result
        found = {
            "converged": result.converged,
            "frames": result.frames,
            "pokes": [one.poke for one in result.rounds],
            "errors": [one.gains.common_sigma for one in result.rounds],
        }
        seed.add_record("bootstrap", found)
        for gains in result.comparisons.values():
            matrix = scale_matrix(measured, clip_gains(gains), gains.best_sigma)
            seed.save_matrix("docrime-gains", replace(escape, matrix=matrix, measured=None), bench)
        return run.rescaled_calibration

    scaled = {ESCAPE + GAINS: seed.matrix("gains", rescaled_matrix)}
    if others:
        scaled[DOCRIME + GAINS] = seed.matrix("docrime-gains", rescaled_matrix)
    return scaled


def matrices(seed: SeedRun) -> dict[str, CalibrationResult]:
    """The matrices of a seed, by name."""
    options = seed.options
    escape = seed.matrix("escape", lambda bench: bench.calibrate("escape", frames=options.calibration))
    if escape.measured is None:
        raise SystemExit(f"{options.calibration} frames are too few for a DO-CRIME matrix")
    found = scaled_by_optical_gains(seed, escape) if options.gains else {ESCAPE: escape}
    if options.baseline:
        found[BASELINE] = seed.matrix(
            "push-pull", lambda bench: bench.calibrate("push-pull", frames=options.baseline, grid=escape.grid)
        )
    found[DOCRIME] = replace(escape, matrix=escape.measured, measured=None)
    return found


def registration_line(seed: SeedRun, name: str, frames: int) -> Line:
    """Error and standard error of the registration from a number of frames."""
    estimate = seed.matrix(name, lambda bench: bench.calibrate("escape", frames=frames)).registration
    if estimate is None:
        raise SystemExit(f"{frames} frames gave no registration")
    config = load_system(seed.options.system, overrides=seed.options.set)
    injected = config.twin.registration.to_registration()
    return {
        "frames": frames, "converged": estimate.converged, "warnings": list(estimate.warnings),
        "error": (estimate.registration.to_array() - injected.to_array()).tolist(),
        "sigma": estimate.sigma.tolist(),
    }  # fmt: skip


def closed_loop_strehl(
    seed: SeedRun,
    name: str,
    result: CalibrationResult,
    share: float,
    factor: float,
    frames: int,
    from_s: float,
) -> float:
    """Strehl ratio in % of a loop with a matrix; 0 where it is not stable."""
    psf = seed.model_psf()

    def run(bench: System) -> dict[str, Any]:
        get_simulated_bench(bench).advance_to(from_s)
        gain = bench.config.loop.gain * share * factor
        found = bench.run(
            close_loop(bench, result.matrix, result.grid, gain=gain, frames=frames, model_psf=psf)
        )
        strehl = found.strehl.peak.value if found.stable and found.strehl else 0.0
        return {"gain": gain, "strehl": strehl}

    what = f"{name}, {factor} of the gain, {frames} frames from {from_s} s"
    return float(100 * seed.get_or_measure(what, run)["strehl"])


def best_with_margin(scan: Mapping[float, float]) -> float:
    """The gain whose Strehl ratio is highest, counted as the lower one of its own and the next gain's."""
    ordered = sorted(scan)
    lower = {one: min(scan[one], scan[larger]) for one, larger in pairwise(ordered)}
    return max(lower, key=lower.__getitem__)


def evaluate_matrices(seed: SeedRun) -> dict[str, tuple[float, float]]:
    """Strehl ratio in % of each matrix at its own best gain, and that gain relative to the usual one."""
    each, found, options = matrices(seed), {}, seed.options
    reference = next(iter(each.values())).matrix.data.std(0)
    for name, result in each.items():
        # Gains of equal effect, independent of the scale of the matrix.
        share = float(np.median(result.matrix.data.std(0) / reference))
        one = partial(closed_loop_strehl, seed, name, result, share)
        scan = {factor: one(factor, options.scan, 0.0) for factor in FACTORS}
        for _ in range(MAX_FURTHER):
            best = max(scan, key=scan.__getitem__)
            if min(scan) < best < max(scan):
                break
            further = best * RATIO if best == max(scan) else best / RATIO
            scan[further] = one(further, options.scan, 0.0)
        best = best_with_margin(scan)
        found[name] = (one(best, options.loop, EVALUATION_START_S), best)
    return found


def measure_seed(options: argparse.Namespace, number: int, until: float) -> Line:
    """The line of a seed: registrations, Strehl ratios in %, and best gains relative to the usual one."""
    seed = SeedRun(options, number, until)
    loops = evaluate_matrices(seed)
    registrations = [registration_line(seed, "escape", options.calibration)]
    if options.short:
        registrations.insert(0, registration_line(seed, "short", options.short))
    return {
        "commit": get_git_state(), "registrations": registrations,
        "strehl": {name: value for name, (value, _) in loops.items()},
        "factor": {name: factor for name, (_, factor) in loops.items()},
    }  # fmt: skip


def strehl_lines(rows: Sequence[Line]) -> list[str]:
    """Table of Strehl ratios by seed, and the differences paired by seed."""
    names = [name for name in PAIRED if any(name in row["strehl"] for row in rows)]
    lines = ["| seed | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]
    for row in rows:
        cells = " | ".join(f"{row['strehl'].get(name, np.nan):.2f}" for name in names)
        lines.append(f"| {row['realisation']} | {cells.replace('nan', '-')} |")
    values = {name: np.array([row["strehl"].get(name, np.nan) for row in rows]) for name in names}
    lines += ["| mean | " + " | ".join(f"{np.nanmean(values[name]):.2f}" for name in names) + " |", ""]
    for one, other in combinations(names, 2):
        difference = values[one] - values[other]
        known = difference[np.isfinite(difference)]
        lines.append(f"- {one} minus {other}, n = {known.size}: {mean_interval(known)} % of Strehl ratio")
    return lines


def registration_lines(rows: Sequence[Line]) -> list[str]:
    """Table of the registration's rms error and normalised chi-squared, by number of frames."""
    heading = " | ".join(f"{name.replace('_', ' ')} [{UNITS[name]}]" for name in PARAMETERS)
    lines = [f"| frames | converged | {heading} |", "|---" * (2 + len(PARAMETERS)) + "|"]
    for columns in zip(*(row["registrations"] for row in rows), strict=True):
        errors, sigmas = (np.array([one[key] for one in columns]) for key in ("error", "sigma"))
        rms, chi2 = np.sqrt(np.mean(errors**2, axis=0)), np.mean(np.square(errors / sigmas), axis=0)
        cells = " | ".join(f"{a:.3f} ({b:.1f})" for a, b in zip(rms, chi2, strict=True))
        good = sum(one["converged"] for one in columns)
        lines.append(f"| {columns[0]['frames']} | {good} of {len(columns)} | {cells} |")
    return lines


def page(rows: Sequence[Line], title: str, raw: str) -> list[str]:
    """The page of a raw table."""
    asked = rows[0]["asked"]
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    return [
        f"# {title}", "",
        f"{len(rows)} seeds, commit {commits}. Raw table: [`{raw}`]({raw}). Made by "
        "`benchmarks/studies/loops/loop_comparison.py` with", "",
        *(f"- {key}: {value}" for key, value in asked.items()), "",
        "## Strehl ratio in %, each matrix at its own best gain (with a margin), on equal turbulence", "",
        *strehl_lines(rows), "", "## Registration: rms error (normalised chi-squared)", "",
        *registration_lines(rows),
    ]  # fmt: skip


def comparison_parser(description: str | None, system: str) -> argparse.ArgumentParser:
    """The options of a comparison."""
    parser = study_parser(description, system)
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(1, 11)))
    parser.set_defaults(out=Path("paired"))
    parser.add_argument("--minutes", type=float, default=np.inf, help="start nothing new after this time")
    parser.add_argument("--calibration", type=int, default=1500, help="frames of ESCAPE")
    parser.add_argument("--short", type=int, default=0, help="frames of a second, shorter ESCAPE; 0: none")
    parser.add_argument("--baseline", type=int, default=20, help="push-pull: frames per push and per pull")
    parser.add_argument("--no-baseline", dest="baseline", action="store_const", const=0)
    parser.add_argument("--no-gains", dest="gains", action="store_false", help="no optical gains")
    parser.add_argument("--frames", type=int, default=1200, help="frames per round of the bootstrap, at most")
    parser.add_argument("--accuracy", type=float, default=0.06, help="of the gains")
    parser.add_argument("--scan", type=int, default=400, help="frames of each loop of the gain search")
    parser.add_argument("--loop", type=int, default=1200, help="frames of each evaluated loop")
    parser.add_argument("--table", type=Path, help="folder of the raw table and its page; default: --out")
    parser.add_argument("--name", default="paired")
    return parser


def complete_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Line:
    """Check and complete the options; the settings that every line keeps.

    Raises
    ------
    SystemExit
        The loops are too short for a Strehl ratio.
    """
    config = load_system(options.system, overrides=options.set)
    science = config.devices.science or config.devices.wfs
    least = minimum_strehl_frames(config.devices.wfs.frame_rate_hz, science.frame_rate_hz)
    if min(options.scan, options.loop) < least:
        parser.error(f"--scan and --loop: at least {least} frames of {options.system} give a Strehl ratio")
    is_pyramid = isinstance(config.sensor, PyramidSection)
    options.gains = options.gains and is_pyramid
    keys = ("system", "set", "calibration", "short", "baseline", "gains", "scan", "loop")
    return {key: getattr(options, key) for key in keys}


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = comparison_parser(__doc__, "razor-pywfs")
    options = parser.parse_args()
    asked = complete_options(parser, options)
    until, stem = time.monotonic() + 60 * options.minutes, f"{options.system}-{options.name}"
    folder = options.table or options.out
    target = folder / f"{stem}.jsonl"
    try:
        each_realisation(target, asked, options.seeds, lambda number: measure_seed(options, number, until))
    except TimeBudgetExceeded:
        print("the time is over; the same command continues")
    if rows := read_lines(target):
        lines = page(rows, f"Paired loops: {options.system}", target.name)
        (folder / f"{stem}.md").write_text("\n".join(lines) + "\n")
        print(*lines, sep="\n")


if __name__ == "__main__":
    main()
