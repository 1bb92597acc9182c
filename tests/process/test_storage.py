"""A full disk: one line of error, no partial file, the mirror made safe first."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys

import pytest
from running import ESCAPE

from escape_hw.io.fits.matrix import load_matrix

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits and devices of Linux")


def at_most(size: int):
    """Files of this process grow no further than ``size`` bytes, as on a full disk."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


@pytest.mark.parametrize("method", ["docrime", pytest.param("escape", marks=pytest.mark.slow)])
def test_no_room_for_the_matrix(escape, system, tmp_path, method):
    out = tmp_path / "run"
    words = ("calibrate", system, "--method", method, "--frames", 300, "--out", out, "--json")
    done = escape(*words, preexec_fn=at_most(60_000))
    assert done.returncode == 1, done.stderr
    document = json.loads(done.stdout)
    assert document["error"]["type"] == "StorageError"
    assert "cannot be written" in document["error"]["message"]
    assert str(out) in document["error"]["message"]
    assert "Traceback" not in done.stderr
    # Neither a product nor a piece of one.
    assert {path.name for path in out.iterdir()} == {"config.toml", "run.log"}
    assert "did not close cleanly" not in (out / "run.log").read_text()


@pytest.mark.slow
def test_no_room_after_the_matrix(escape, system, im, tmp_path):
    """The matrix fits, the report does not: the matrix is kept."""
    out = tmp_path / "run"
    words = ("calibrate", system, "--method", "docrime", "--frames", 300, "--out", out, "--json")
    # A state of the run, which a busy computer would have time to keep, is larger than the matrix.
    words += ("--set", "calibration.checkpoint_s=600")
    done = escape(*words, preexec_fn=at_most(im.stat().st_size + 2880))
    assert done.returncode == 1, done.stderr
    assert json.loads(done.stdout)["error"]["type"] == "StorageError"
    assert not load_matrix(out / "im.fits").result.partial
    assert json.loads((out / "result.json").read_text())["products"]["im"] == "im.fits"
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("where", ["/dev/full/run", "/proc/run", "FILE/run"])
def test_a_folder_that_cannot_be_stops_the_command_before_anything_opens(escape, system, tmp_path, where):
    (tmp_path / "file").write_text("")
    out = where.replace("FILE", str(tmp_path / "file"))
    done = escape("calibrate", system, "--out", out, "--json")
    assert done.returncode == 2, done.stderr
    assert json.loads(done.stdout)["error"]["type"] == "StorageError"
    assert "DO-CRIME" not in done.stderr


def test_no_room_for_the_configuration_stops_the_command_before_anything_opens(escape, system, tmp_path):
    words = ("calibrate", system, "--method", "docrime", "--out", tmp_path / "run", "--json")
    done = escape(*words, preexec_fn=at_most(1000))
    assert done.returncode == 2, done.stderr
    assert json.loads(done.stdout)["error"]["type"] == "StorageError"
    assert "DO-CRIME" not in done.stderr


@pytest.mark.parametrize("words", [("systems", "--json"), ("systems",)])
def test_a_result_that_cannot_be_delivered_is_no_success(environment, words):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*ESCAPE, *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=environment,
            timeout=60,
        )
    assert done.returncode == 1
    assert done.stderr.strip() == "error: standard output cannot be written (No space left on device)"


@pytest.mark.parametrize("more", [("--json",), ()])
def test_a_closed_pipe_is_no_success_and_no_crash(environment, im, more):
    with subprocess.Popen(
        [*ESCAPE, "show", im, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        process.stdout.close()
        told = process.stderr.read()
        assert process.wait(60) == 1
    # A table that is cut off, as by "| head", is nothing to talk about; a lost document is.
    assert told.strip() == ("error: standard output cannot be written (Broken pipe)" if more else "")
