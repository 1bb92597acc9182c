"""Central lines changed on purpose: the quick tests must notice each. ``python tests/mutations.py [NAME]``.

Each mutation is made in a copy of the working tree, in which the tests that should notice it are run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Name: file, line (once in it), what it becomes, tests of the quick suite that must fail.
MUTATIONS = {
    "sign of push-pull": (
        "escape_hw/calibration/push_pull/procedure.py", "(means[0] - means[1])", "(means[1] - means[0])",
        "tests/unit/test_public_api.py::test_push_pull_takes_the_turbulence_out_and_puts_it_back",
    ),
    "stroke limit of the guard": (
        "escape_hw/safety/guard.py", "shape = _clamp(shape, lim.max_stroke)", "shape = _clamp(shape, 1e3)",
        "tests/unit/test_guard.py::test_whatever_goes_in_what_comes_out_obeys",
    ),
    "sum of all commands in the compiled check": (
        "escape_hw/safety/compiled_check.py", "if not total <= max_abs_sum:",
        "if not total <= 2 * max_abs_sum:", "tests/unit/test_guard_action.py",
    ),
    "leak of the integrator": (
        "escape_hw/pipeline/control/integrator.py", "np.float32(1 - leak)", "np.float32(1)",
        "tests/unit/test_integrator.py",
    ),
    "Jacobian of SPRINT": (
        "escape_hw/calibration/sprint/least_squares.py", "self.gain * self.derivatives]",
        "-self.gain * self.derivatives]",
        "tests/known_truth/test_bases.py::test_every_solver_gives_the_registration[registration-only]",
    ),
    "phase of the demodulation": (
        "escape_hw/calibration/push_pull/demodulation.py", "[steps.imag, steps.real]",
        "[steps.imag, -steps.real]", "tests/known_truth/test_demodulation.py",
    ),
    "delay search": (
        "escape_hw/calibration/push_pull/demodulation.py", "np.exp(-2j * np.angle(responses))",
        "np.exp(2j * np.angle(responses))", "tests/known_truth/test_demodulation.py::test_delay_over_seeds",
    ),
    "lag of DO-CRIME": (
        "escape_hw/calibration/docrime/response.py", "rows[now[0] - lag : now[-1] - lag + 1]",
        "rows[now[0] - lag - 1 : now[-1] - lag]", "tests/known_truth/test_docrime_estimator.py",
    ),
    "limit of the watchdog": (
        "escape_hw/server/safety/watchdog.py", "if silent <= limit:", "if silent <= 100 * limit:",
        "tests/unit/test_watchdog.py::test_no_frames_in_closed_loop",
    ),
    "silence of an engine that runs": (
        "escape_hw/server/frontend/engine_supervisor.py", "idle = state.active_run is None and", "idle =",
        "tests/unit/test_engine_silence.py",
    ),
    "checksum of FITS files": (
        "escape_hw/io/fits/file.py", "% 0xFFFFFFFF:", "% 0xFFFFFFFF and False:", "tests/unit/test_fits.py",
    ),
    "lease of a client": (
        "escape_hw/server/frontend/lease.py", "        if self._holder is client:\n            return",
        "        if client is not None:\n            return", "tests/unit/test_lease.py",
    ),
}  # fmt: skip


def failures(tests: str, copy: Path, environment: dict[str, str]) -> list[str]:
    """Lines of pytest that name the tests that failed in a copy."""
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", tests]
    done = subprocess.run(words, cwd=copy, env=environment, capture_output=True, text=True)
    return [row for row in done.stdout.splitlines() if row.startswith(("FAILED", "ERROR"))]


def main() -> int:
    """Number of mutations that nothing noticed."""
    unnoticed = 0
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "_build"))
        folders = (copy, copy / "drivers", copy / "sim_backends", copy / "benchmarks")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
        for name in sys.argv[1:] or MUTATIONS:
            file, line, mutated, tests = MUTATIONS[name]
            text = (copy / file).read_text(encoding="utf-8")
            if text.count(line) != 1:
                raise SystemExit(f"{name}: {file} has the line {text.count(line)} times: {line}")
            if failed := failures(tests, copy, environment):
                raise SystemExit(f"{name}: fails without a mutation: {failed[0]}")
            (copy / file).write_text(text.replace(line, mutated), encoding="utf-8")
            failed = failures(tests, copy, environment)
            (copy / file).write_text(text, encoding="utf-8")
            unnoticed += not failed
            print(f"{name}: {failed[0].partition(' - ')[0] if failed else 'NOT NOTICED'}", flush=True)
    return unnoticed


if __name__ == "__main__":
    sys.exit(main())
