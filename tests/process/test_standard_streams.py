"""Standard output and standard error that end before the command does, with and without Python's buffers."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from running import ESCAPE

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="devices of Linux")

#: Short commands with a table, with a document, and those that end before any command begins.
COMMANDS = [("systems",), ("systems", "--json"), ("--help",)]
#: Every command with Python's buffers, and in the quick suite one of them without.
EVERY = pytest.mark.parametrize(
    ("bare", "words"),
    [
        pytest.param(
            bare,
            words,
            id=f"{bare}-{' '.join(words)}",
            marks=() if bare == "buffered" or words == COMMANDS[1] else pytest.mark.slow,
        )
        for bare in ("buffered", "unbuffered")
        for words in COMMANDS
    ],
    indirect=["bare"],
)
#: What the message says of a full device, and of a pipe.
NO_ROOM, NO_READER = "No space left on device", "Broken pipe"


@pytest.fixture(scope="module", params=["buffered", pytest.param("unbuffered", marks=pytest.mark.slow)])
def bare(request, tmp_path_factory) -> dict[str, str]:
    """An environment with nothing in it that this test does not put there."""
    home = tmp_path_factory.mktemp("home")
    told = {"HOME": str(home), "PATH": os.defpath, "LANG": "C.UTF-8", "OPENBLAS_NUM_THREADS": "1"}
    told["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return told | ({"PYTHONUNBUFFERED": "1"} if request.param == "unbuffered" else {})


def ended(words, environment, **streams) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [*ESCAPE, *map(str, words)], text=True, check=False, env=environment, timeout=240, **streams
    )


def without_reader() -> int:
    """The end of a pipe that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


def closing(descriptor: int):
    """As ``>&-`` of a shell."""
    return lambda: os.close(descriptor)


@EVERY
def test_a_full_device_is_no_success(bare, words):
    with open("/dev/full", "w") as full:
        done = ended(words, bare, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    assert done.stderr == f"error: standard output cannot be written ({NO_ROOM})\n"


@EVERY
def test_a_pipe_without_a_reader_is_no_success(bare, words):
    nobody = without_reader()
    done = ended(words, bare, stdout=nobody, stderr=subprocess.PIPE)
    os.close(nobody)
    assert done.returncode == 1
    # A table that is cut off is nothing to talk about; a lost document is.
    lost = "--json" in words
    assert done.stderr == (f"error: standard output cannot be written ({NO_READER})\n" if lost else "")


@pytest.mark.slow
def test_the_first_lines_of_a_long_table(bare, im):
    """As ``escape show FILE | head -1``, where the rest may have been written before the pipe was closed."""
    with subprocess.Popen(
        [*ESCAPE, "show", im], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=bare
    ) as process:
        process.stdout.readline()
        process.stdout.close()
        told = process.stderr.read()
        assert process.wait(60) in (0, 1)
    assert told == ""


@EVERY
def test_a_command_without_standard_output(bare, words):
    done = ended(words, bare, stderr=subprocess.PIPE, preexec_fn=closing(1))
    assert done.returncode == 1
    assert done.stderr == "error: standard output cannot be written (Bad file descriptor)\n"


@pytest.fixture(scope="module", params=COMMANDS[1:], ids=" ".join)
def whole(bare, request) -> tuple[tuple[str, ...], str]:
    """A command, and its output where nothing is in the way."""
    done = ended(request.param, bare, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout
    return request.param, done.stdout


@pytest.mark.parametrize("end", ["full", "pipe", "none"])
def test_standard_error_changes_no_result(bare, whole, end):
    words, output = whole
    told = {"full": lambda: os.open("/dev/full", os.O_WRONLY), "pipe": without_reader}.get(end)
    nobody = subprocess.DEVNULL if told is None else told()
    streams = {"stdout": subprocess.PIPE, "stderr": nobody}
    done = ended(words, bare, **streams, **({"preexec_fn": closing(2)} if told is None else {}))
    if told is not None:
        os.close(nobody)
    assert (done.returncode, done.stdout) == (0, output)


@pytest.mark.parametrize("words", [("systms",), ("systems", "--jsn")], ids=" ".join)
@pytest.mark.parametrize("end", ["full", "pipe"])
def test_a_wrong_command_stays_one(bare, words, end):
    nobody = without_reader() if end == "pipe" else os.open("/dev/full", os.O_WRONLY)
    done = ended(words, bare, stdout=nobody, stderr=nobody)
    os.close(nobody)
    assert done.returncode == 2


@pytest.mark.parametrize("bare", ["buffered"], indirect=True)
@pytest.mark.parametrize("end", ["full", "pipe"])
@pytest.mark.slow
def test_a_run_whose_progress_is_not_read_is_finished(bare, system, tmp_path, end):
    """It takes long enough for many lines of progress."""
    nobody = without_reader() if end == "pipe" else os.open("/dev/full", os.O_WRONLY)
    words = ("calibrate", system, "--method", "docrime", "--frames", 300, "--out", tmp_path / "run")
    done = ended(words, bare, stdout=subprocess.PIPE, stderr=nobody)
    os.close(nobody)
    assert done.returncode == 0
    assert (tmp_path / "run" / "im.fits").is_file()
    assert "Traceback" not in (tmp_path / "run" / "run.log").read_text()
    assert done.stdout


@pytest.mark.parametrize("bare", ["buffered"], indirect=True)
@pytest.mark.slow
def test_a_loop_whose_streams_share_a_pipe_without_a_reader_keeps_its_data(bare, system, im, tmp_path):
    """As ``escape loop ... 2>&1 | head -1``."""
    nobody = without_reader()
    words = ("loop", system, "--im", im, "--frames", 300, "--out", tmp_path / "run")
    done = ended(words, bare, stdout=nobody, stderr=nobody)
    os.close(nobody)
    assert done.returncode == 1, "the results could not be printed"
    assert (tmp_path / "run" / "loop.fits").is_file()
    assert "Traceback" not in (tmp_path / "run" / "run.log").read_text()


LOCALES = {
    "ascii": {"PYTHONIOENCODING": "ascii"},
    "latin": {"PYTHONIOENCODING": "latin-1"},
    "unknown": {"LANG": "en_US.ISO-8859-1", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "C": {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}


@pytest.mark.parametrize("bare", ["buffered"], indirect=True)
@pytest.mark.parametrize("locale", LOCALES)
@pytest.mark.parametrize(
    ("words", "code"),
    [(("--help",), 0), (("doctor",), None), (("show", "n\N{LATIN SMALL LETTER O WITH DIAERESIS}"), 2)],
    ids=["help", "doctor", "path"],
)  # fmt: skip
@pytest.mark.slow
def test_every_locale(bare, locale, words, code):
    environment = {**bare, **LOCALES[locale]}
    done = subprocess.run(
        [*ESCAPE, *map(os.fsencode, words)], capture_output=True, check=False, env=environment, timeout=60
    )
    assert done.returncode in ((0, 1) if code is None else (code,)), done.stderr
    assert b"Traceback" not in done.stderr
    assert b"defect of ESCAPE" not in done.stderr
    (done.stdout + done.stderr).decode("latin-1" if locale == "latin" else "ascii")
