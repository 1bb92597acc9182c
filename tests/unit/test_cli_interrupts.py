"""Ctrl-C in the middle of a command saves the measured data and leaves the mirror flat."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import fake_bench
import pytest

from escape_hw.io.fits.loop import load_loop
from escape_hw.io.fits.matrix import load_matrix


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
@pytest.mark.parametrize("method", ["push-pull", "docrime", "escape"])
def test_ctrl_c_in_a_calibration_saves_what_there_is(document, bench, tmp_path, method, number):
    bench.hook = lambda name: os.kill(os.getpid(), number)
    before = signal.getsignal(number)
    code, found, err = document("calibrate", "razor-shwfs", "--method", method, "--out", tmp_path / "run")
    assert code == 130
    assert found["error"]["type"] == "Aborted"
    assert found["partial"] is True
    path = Path(found["products"]["im"])
    assert path.name == "im.partial.fits"
    assert load_matrix(path).result.partial
    assert "stopping: the mirror is being flattened and the devices closed\n" in err
    assert "no result was saved" not in err
    assert bench.benches[0].closed
    assert bench.benches[0].screen.state.inserted
    assert signal.getsignal(number) is before
    saved = json.loads((tmp_path / "run" / "result.json").read_text())
    assert saved["partial"] is True
    assert saved["verdict"]["quality"] == "aborted"
    stop = saved["stopped_at"]
    assert f"{stop['stage']} stopped after {stop['done']} of {stop['total']}" in saved["verdict"]["reason"]


def test_ctrl_c_in_the_loop(document, bench, im, tmp_path):
    bench.hook = lambda name: name == "closed_loop" and os.kill(os.getpid(), signal.SIGINT)
    code, found, _ = document("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert code == 130
    assert load_loop(found["products"]["loop"]).result.partial
    assert bench.benches[0].closed


def test_ctrl_c_before_anything_was_measured(document, bench, im, tmp_path):
    bench.hook = lambda name: name == "model_psf" and os.kill(os.getpid(), signal.SIGINT)
    code, found, err = document("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (130, "Aborted")
    assert "saved" not in err.replace("no result was saved", "")
    assert "no result was saved" in err
    assert bench.benches[0].closed


def test_second_ctrl_c_breaks_into_a_hanging_procedure(document, bench, tmp_path):
    def hang(name: str) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    bench.hook = hang
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (130, "Aborted")
    assert bench.benches[0].closed


def test_ctrl_c_while_closing_does_not_keep_the_mirror_from_its_flat(document, bench, tmp_path, monkeypatch):
    def close(self: object, *_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        self.closed = True

    monkeypatch.setattr(fake_bench.FakeBench, "__exit__", close)
    code, _, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert code == 0
    assert "being flattened" in err
    assert bench.benches[0].closed


@pytest.mark.parametrize("place", ["escape", "push-pull", "model_psf", "closed_loop"])
def test_ctrl_c_in_a_reproduction_keeps_what_is_done(document, bench, tmp_path, place):
    bench.hook = lambda name: name == place and os.kill(os.getpid(), signal.SIGINT)
    code, found, _ = document("reproduce", "shwfs", "--out", tmp_path / "run", "--realisations", 0)
    assert code == 130
    assert found["partial"] is True
    assert found["criteria"] == []
    done = {"escape": 0, "push-pull": 2, "model_psf": 3, "closed_loop": 3}[place]
    paths = [
        Path(path) for name, path in found["products"].items() if name in ("push_pull", "docrime", "escape")
    ]
    assert sum(not path.name.endswith(".partial.fits") for path in paths) == done
    assert bench.benches[0].closed
    assert bench.benches[0].screen.state.inserted


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_the_message_names_the_signal(document, bench, tmp_path, monkeypatch, number, name):
    def hang(place: str) -> None:
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)

    bench.hook = hang
    _, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert found["error"]["message"] == f"interrupted by {name}"

    monkeypatch.setattr(
        "escape_hw.cli.context.CommandContext.load_config", lambda *_: os.kill(os.getpid(), number)
    )
    _, found, err = document("config", "check", "razor-shwfs")
    assert found["error"]["message"] == f"interrupted by {name}"
    assert f"aborted: interrupted by {name}" in err


@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "SIGTERM")])
def test_an_interruption_that_a_library_turns_into_its_own_error(document, monkeypatch, number, name):
    def load(*_, **__):
        try:
            os.kill(os.getpid(), number)
        except KeyboardInterrupt:
            raise ValueError("half of a module") from None

    monkeypatch.setattr("escape_hw.cli.context.CommandContext.load_config", load)
    code, found, err = document("config", "check", "razor-shwfs")
    assert code == 130
    assert found["error"]["type"] == "Aborted"
    assert found["error"]["message"] == f"interrupted by {name} (ValueError)"
    assert "Traceback" not in err
