"""Strehl ratios on equal turbulence of ESCAPE with optical gains, push-pull (the baseline) and DO-CRIME
alone.

    python benchmarks/studies/loop_comparison.py --seeds 1 2 3 4 5 6 7 8 9 10 --out paired

Each seed is a twin with a mirror and turbulence of its own. Every matrix is closed at its own best gain,
found on the first seconds of that turbulence, and judged on later ones, the same for all three. Matrices and
loops are kept in a folder as soon as they are done and are not made again; with ``--minutes 4`` nothing new
is begun after four minutes, and the next call goes on. Prints the table of the seeds that are finished, with
the differences paired by seed. A seed of the pyramid bench takes some six minutes on an idle core.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realisation_tables import append_line, read_lines, study_parser

from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import get_simulated_bench

ESCAPE, BASELINE, DOCRIME = "ESCAPE with optical gains", "push-pull", "DO-CRIME alone"
#: Start times of judged loops and bootstrap on the twin's clock, each after the previous turbulence.
EVALUATION_START_S, BOOTSTRAP_START_S = 4.0, 10.0
#: Gains tried, relative to the usual one in effect; the best at an end is followed one further.
FACTORS, BELOW, ABOVE = (0.85, 1.0, 1.2), 0.7, 1.4


class TimeBudgetExceeded(Exception):
    """It is time to begin nothing new."""


class SeedRun:
    """One twin: its matrices and loops, kept in a folder.

    Parameters
    ----------
    options
        The command line.
    number
        The seed.
    until
        Time of the monotonic clock after which nothing is begun.
    """

    def __init__(self, options: argparse.Namespace, number: int, until: float) -> None:
        self.options, self.number, self._until = options, number, until
        self._folder = options.out / f"{options.system}-{number}"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lines = self._folder / "loops.jsonl"
        self._records: dict[str, dict[str, Any]] = {row["what"]: row for row in read_lines(self._lines)}

    def open_bench(self) -> System:
        """A bench in its first state: what is done on it does not depend on what was done before."""
        if time.monotonic() > self._until:
            raise TimeBudgetExceeded
        return open_system(self.options.system, seed=self.number, set=self.options.set)

    def matrix(self, name: str, make: Callable[[System], CalibrationResult]) -> CalibrationResult:
        """A matrix, made unless it is kept."""
        path = self._folder / f"{name}.fits"
        if not path.exists():
            with self.open_bench() as bench:
                save_matrix(path, make(bench), BenchRecord.from_bench(bench).origin())
        return load_matrix(path).result

    def model_psf(self) -> NDArray[np.float32]:
        """The image without turbulence."""
        path = self._folder / "model_psf.npy"
        if not path.exists():
            with self.open_bench() as bench:
                np.save(path, bench.take_model_psf(frames=5))
        return np.asarray(np.load(path))

    def get_or_measure(self, what: str, make: Callable[[System], dict[str, Any]]) -> dict[str, Any]:
        """A line of the book, made unless it is kept."""
        if what not in self._records:
            with self.open_bench() as bench:
                self.add_record(what, make(bench))
        return self._records[what]

    def add_record(self, what: str, found: dict[str, Any]) -> None:
        """Write a line into the book."""
        self._records[what] = {"what": what, **found}
        append_line(self._lines, self._records[what])
        print(f"seed {self.number}: {json.dumps(self._records[what])}", flush=True)


def matrices(seed: SeedRun) -> dict[str, CalibrationResult]:
    """The three matrices of a seed, by name."""
    options = seed.options
    escape = seed.matrix("escape", lambda bench: bench.calibrate("escape", frames=options.calibration))
    baseline = seed.matrix(
        "push-pull", lambda bench: bench.calibrate("push-pull", frames=options.baseline, grid=escape.grid)
    )
    if escape.measured is None:
        raise SystemExit(f"{options.calibration} frames are too few for a DO-CRIME matrix")

    def rescaled_matrix(bench: System) -> CalibrationResult:
        get_simulated_bench(bench).advance_to(BOOTSTRAP_START_S)
        run = bench.run(
            bootstrap_gains(
                bench,
                escape,
                frames=options.frames,
                accuracy=options.accuracy,
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
        return run.rescaled_calibration

    gains = seed.matrix("gains", rescaled_matrix)
    docrime = replace(escape, matrix=escape.measured, measured=None)
    return {ESCAPE: gains, BASELINE: baseline, DOCRIME: docrime}


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
        is_valid = found.stable and found.strehl is not None
        return {"gain": gain, "strehl": found.strehl.peak.value if is_valid else 0.0}

    what = f"{name}, {factor} of the gain, {frames} frames from {from_s} s"
    return float(100 * seed.get_or_measure(what, run)["strehl"])


def evaluate_matrices(seed: SeedRun) -> dict[str, tuple[float, float]]:
    """Strehl ratio in % of each matrix at its own best gain, and that gain relative to the usual one."""
    each, found, options = matrices(seed), {}, seed.options
    for name, result in each.items():
        # Gains that are alike in their effect, whatever the matrix's scale.
        share = float(np.median(result.matrix.data.std(0) / each[ESCAPE].matrix.data.std(0)))
        one = partial(closed_loop_strehl, seed, name, result, share)
        scan = {factor: one(factor, options.scan, 0.0) for factor in FACTORS}
        end = {FACTORS[0]: BELOW, FACTORS[-1]: ABOVE}.get(max(scan, key=scan.__getitem__))
        if end is not None:
            scan[end] = one(end, options.scan, 0.0)
        best = max(scan, key=scan.__getitem__)
        found[name] = (one(best, options.loop, EVALUATION_START_S), best)
    return found


def table(found: dict[int, dict[str, tuple[float, float]]]) -> list[str]:
    """Lines of the table: each seed, means with the scatter of the seeds, differences paired by seed."""
    names = (ESCAPE, BASELINE, DOCRIME)
    lines = ["| seed | " + " | ".join(names) + " |", "|---" * 4 + "|"]
    for number, one in sorted(found.items()):
        lines.append(f"| {number} | " + " | ".join(f"{one[name][0]:.2f}" for name in names) + " |")
    values = {name: np.array([one[name][0] for one in found.values()]) for name in names}
    lines.append("| mean | " + " | ".join(f"{values[name].mean():.2f}" for name in names) + " |")
    for one, other in ((ESCAPE, BASELINE), (DOCRIME, BASELINE), (DOCRIME, ESCAPE)):
        difference = values[one] - values[other]
        error = difference.std(ddof=1) / np.sqrt(difference.size) if difference.size > 1 else np.nan
        lines.append(f"{one} minus {other}: {difference.mean():+.2f} +- {error:.2f} % of Strehl ratio")
    return lines


def main() -> None:
    """Measure what is missing, and print what there is."""
    parser = study_parser(__doc__, "razor-pywfs")
    parser.add_argument("--set", nargs="*", default=[])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(1, 11)))
    parser.set_defaults(out=Path("paired"))
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin nothing after so long")
    parser.add_argument("--calibration", type=int, default=1500, help="frames of ESCAPE")
    parser.add_argument("--baseline", type=int, default=20, help="push-pull: frames per push and per pull")
    parser.add_argument("--frames", type=int, default=1200, help="frames per round of the bootstrap, at most")
    parser.add_argument("--accuracy", type=float, default=0.06, help="of the gains")
    parser.add_argument("--scan", type=int, default=400, help="frames of each loop that looks for the gain")
    parser.add_argument("--loop", type=int, default=1200, help="frames of each loop that is judged")
    options = parser.parse_args()
    until, found = time.monotonic() + 60 * options.minutes, {}
    for number in options.seeds:
        try:
            found[number] = evaluate_matrices(SeedRun(options, number, until))
        except TimeBudgetExceeded:
            continue
    if found:
        print(*table(found), sep="\n")


if __name__ == "__main__":
    main()
