"""Ctrl-C in the middle of each procedure: exit code 130 within a second, partial data saved."""

from __future__ import annotations

import json
import os
import pty
import select
import shlex
import signal
import sys
import time
from pathlib import Path

import pytest
from running import ESCAPE

from escape_hw.io.fits.loop import load_loop
from escape_hw.io.fits.matrix import load_matrix

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads processor time in /proc")

#: A loop or a calibration that nobody waits for.
ENDLESS = 10_000_000
#: In real time and slowly, so that stages of a few hundred frames last for seconds.
SLOW = [
    word
    for key in ("twin.paced=true", "devices.wfs.frame_rate_hz=40", "devices.science.frame_rate_hz=5")
    for word in ("--set", key)
]
CALIBRATE, LOOP = ("calibrate", "SYSTEM"), ("loop", "SYSTEM", "--im", "IM")
SHWFS, TABLE1 = ("reproduce", "shwfs", "--system", "SYSTEM"), ("reproduce", "table1", "--system", "SYSTEM")
#: Command; line of progress to wait for; seconds of work after it, so that there is something to keep;
#: products that are whole; products that say they are partial.
PLACES = {
    "grid": ((*CALIBRATE, "--method", "push-pull", *SLOW), "find the lenslet grid", 0, [], []),
    "push-pull": ((*CALIBRATE, "--method", "push-pull", "--frames", 100), "push-pull", 1.0, [], ["im"]),
    "DO-CRIME": ((*CALIBRATE, "--method", "docrime", "--frames", ENDLESS), "DO-CRIME", 0.8, [], ["im"]),
    "ESCAPE": ((*CALIBRATE, "--frames", ENDLESS), "DO-CRIME", 0.8, [], ["im"]),
    "model PSF": ((*LOOP, *SLOW), "model PSF", 0, [], []),
    "best gain": ((*LOOP, "--best-gain", "--no-strehl", *SLOW), "loop at gain", 0.2, [], ["loop"]),
    "closed loop": ((*LOOP, "--frames", ENDLESS), "closed loop", 0.5, [], ["loop"]),
    "reproduce, DO-CRIME": ((*SHWFS, "--frames", ENDLESS), "DO-CRIME", 0.8, [], ["docrime"]),
    "reproduce, push-pull": (
        (*SHWFS, "--frames", 400), "push-pull", 0.2, ["docrime", "escape"], ["push_pull"],
    ),
    "reproduce, closed loop": (
        (*SHWFS, "--frames", 400, "--loop-frames", ENDLESS), "closed loop", 0.5,
        ["push_pull", "docrime", "escape"], ["loop_push_pull"],
    ),
    "table 1": (
        (*TABLE1, "--short", 400, "--long", ENDLESS), f"DO-CRIME: 1 of {ENDLESS}", 0.8,
        ["docrime_short", "escape_short"], ["docrime_long"],
    ),
}  # fmt: skip
QUICK = ("push-pull", "DO-CRIME", "closed loop")


def check_products(folder: Path, whole: list[str], partial: list[str]) -> None:
    """Exactly these products, each sound, and no leftovers."""
    names = {path.name for path in folder.iterdir()}
    wanted = {f"{name}.fits" for name in whole} | {f"{name}.partial.fits" for name in partial}
    assert {name for name in names if name.endswith(".fits")} == wanted
    assert not [name for name in names if name.startswith(".")]
    for name in wanted:
        load = load_loop if name.startswith("loop") else load_matrix
        assert load(folder / name).result.partial == name.endswith(".partial.fits")


@pytest.mark.parametrize(
    "place",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in PLACES],
)
def test_ctrl_c_in(start, system, im, tmp_path, place):
    words, line, pause, whole, partial = PLACES[place]
    out = tmp_path / "run"
    running = start(*({"SYSTEM": system, "IM": im}.get(str(word), word) for word in words), "--out", out)
    running.wait_for(line)
    running.let_work(pause)
    ended = running.stop(signal.SIGINT)
    assert ended.code == 130, ended.lines
    # A second of its own time: what other processes take of this machine is not ours to answer for.
    assert ended.cpu_s < 1.0
    assert ended.wall_s < 4.0
    assert any(line.startswith("stopping: ") for line in ended.lines)
    assert any(line.startswith("aborted: ") for line in ended.lines)
    assert not any("Traceback" in line for line in ended.lines)
    assert ended.document["error"]["type"] == "Aborted"
    check_products(out, whole, partial)
    if whole or partial:
        assert ended.document["partial"] is True
        assert json.loads((out / "result.json").read_text())["partial"] is True
        assert "report" not in ended.document["products"]
    log = (out / "run.log").read_text()
    assert "Aborted" in log
    assert "did not close cleanly" not in log


@pytest.mark.slow
def test_ctrl_c_while_sprint_computes(start, tmp_path):
    out = tmp_path / "run"
    running = start("calibrate", "razor-shwfs", "--frames", 600, "--out", out)
    running.wait_for("SPRINT")
    ended = running.stop(signal.SIGINT)
    assert ended.code == 130
    assert ended.cpu_s < 2.0
    check_products(out, [], ["im"])
    assert load_matrix(out / "im.partial.fits").matrix.method == "docrime-whitened"


def test_ctrl_c_prints_the_command_to_resume(start, system, tmp_path):
    first, second = tmp_path / "a run", tmp_path / "again"
    running = start("calibrate", system, "--method", "docrime", "--frames", ENDLESS, "--out", first)
    running.wait_for("DO-CRIME")
    running.let_work(0.5)
    ended = running.stop(signal.SIGINT)
    (way,) = [line.strip() for line in ended.lines if "resume with: " in line]
    words = shlex.split(way.removeprefix("resume with: "))
    assert words == ["escape", "calibrate", "--resume", str(first)]
    taken = ended.document["frames"]
    ended = start(*words[1:], "--frames", taken + 1000, "--out", second).stop()
    assert ended.code == 0, ended.lines
    assert ended.document["frames"] == taken + 1000
    (told,) = [line for line in ended.lines if line.startswith("resuming ")]
    assert str(first) in told
    assert told.endswith(f"products go to {second}")
    assert not any("resume with: " in line for line in ended.lines)


@pytest.mark.parametrize(
    "number",
    [signal.SIGTERM, *(pytest.param(one, marks=pytest.mark.slow) for one in (signal.SIGHUP, signal.SIGQUIT))],
)
def test_a_stop_signal(start, system, tmp_path, number):
    out = tmp_path / "run"
    running = start("calibrate", system, "--method", "docrime", "--frames", ENDLESS, "--out", out)
    running.wait_for("DO-CRIME")
    running.let_work(0.5)
    ended = running.stop(number)
    assert ended.code == 130
    assert ended.document["error"]["type"] == "Aborted"
    check_products(out, [], ["im"])


@pytest.mark.parametrize(
    "pause", [0.03, *(pytest.param(pause, marks=pytest.mark.slow) for pause in (0.0, 0.1))]
)
def test_impatient_ctrl_c_never_leaves_half_a_product(start, system, tmp_path, pause):
    """However many come and whenever: exit code 130, and every file that is there is sound."""
    out = tmp_path / "run"
    running = start("calibrate", system, "--method", "docrime", "--frames", ENDLESS, "--out", out)
    running.wait_for("DO-CRIME")
    running.let_work(0.5)
    ended = running.stop(*[signal.SIGINT] * 5, pause_s=pause)
    assert ended.code == 130, ended.lines
    assert not any("Traceback" in line for line in ended.lines), ended.lines
    for path in out.glob("*.fits"):
        assert load_matrix(path).result.partial
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    assert "did not close cleanly" not in (out / "run.log").read_text()


@pytest.mark.slow
def test_what_was_kept_can_be_used(start, escape, system, tmp_path):
    """The matrix of an aborted run closes a loop, gives a registration and fills a report."""
    out = tmp_path / "run"
    running = start("calibrate", system, "--frames", ENDLESS, "--out", out)
    running.wait_for("DO-CRIME")
    running.let_work(1.0)
    assert running.stop(signal.SIGINT).code == 130
    kept = out / "im.partial.fits"
    found = json.loads(escape("sprint", system, "--im", kept, "--out", tmp_path / "s", "--json").stdout)
    assert found["converged"]
    assert abs(found["registration"]["shift_y"]["value"] + 71) < 3
    loop = escape("loop", system, "--im", kept, "--frames", 300, "--no-strehl", "--out", tmp_path / "l")
    assert loop.returncode == 0, loop.stderr
    assert escape("report", out).returncode == 0
    assert "ABORTED" in (out / "report.html").read_text().upper()


@pytest.mark.slow
def test_a_hang_up_is_ignored_under_nohup(start, system, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        out = tmp_path / "run"
        running = start("calibrate", system, "--method", "docrime", "--frames", 3000, "--out", out)
    finally:
        signal.signal(signal.SIGHUP, before)
    running.wait_for("DO-CRIME")
    assert running.stop(signal.SIGHUP).code == 0


@pytest.mark.slow
def test_a_terminal_that_closes_saves_the_data(system, environment, tmp_path):
    """As a closed window or a lost ssh connection: a hang-up, and streams that fail from then on."""
    out = tmp_path / "run"
    words = ("calibrate", system, "--method", "docrime", "--frames", ENDLESS, "--out", out)
    pid, terminal = pty.fork()
    if pid == 0:
        os.execvpe(ESCAPE[0], [*ESCAPE, *map(str, words)], environment)
    text = b""
    working_until = None
    while working_until is None or time.monotonic() < working_until:
        assert select.select([terminal], [], [], 90)[0], text
        text += os.read(terminal, 1 << 16)
        if b"DO-CRIME" in text and working_until is None:
            working_until = time.monotonic() + 3
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 130
    check_products(out, [], ["im"])
