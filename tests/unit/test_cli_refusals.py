"""Errors of the command line before anything is opened."""

from __future__ import annotations

from dataclasses import replace

import fake_results as fake
import numpy as np
import pytest

from escape_hw.config.loader import load_system
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "razor-shwf"),
        ("calibrate", "razor-shwfs", "--method", "magic"),
        ("calibrate", "razor-shwfs", "--set", "loop.gian=1"),
        ("calibrate", "razor-shwfs", "--set", "loop.gain=99"),
        ("calibrate", "razor-shwfs", "--poke", "nan"),
        ("calibrate", "razor-shwfs", "--method", "docrime", "--accuracy", 1),
        ("calibrate", "razor-shwfs", "--frames", 0),
        ("calibrate", "razor-shwfs", "--frames", "many"),
        ("calibrate", "razor-shwfs", "--no-such-option"),
        ("calibrate",),
        ("calibrate", "--resume", "absent"),
        ("calibrate", "razor-shwfs", "--snr", 0),
        ("calibrate", "razor-shwfs", "--method", "modulated", "--closed-loop", "im.fits"),
        ("calibrate", "razor-shwfs", "--method", "docrime", "--closed-loop", "absent.fits"),
        ("loop", "razor-shwfs"),
        ("loop", "razor-shwfs", "--im", "absent.fits"),
        ("show", "absent.fits"),
        ("report", "absent"),
        ("perf", "no-such-stage"),
        ("nonsense",),
        ("streams", "--seconds", 1e80),
        ("emulate", "e727", "--seconds", 1e80),
        ("modulator", "start", "razor-pywfs", "--seconds", 1e80),
        ("export", "milk", "absent.npy", ""),
        ("discover", "--host", ""),
        ("discover", "--host", "host:port"),
        ("discover", "--host", "host:99999"),
    ],
)
def test_bad_usage_exits_2_with_one_line_and_nothing_opened(escape, document, bench, words):
    code, out, err = escape(*words)
    assert (code, out) == (2, "")
    assert err.strip()
    assert "Traceback" not in err
    code, found, _ = document(*words)
    assert code == 2
    assert found["error"]["message"]
    assert not bench.benches


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("influence", "im.fits", "--out", "im.fits"), "im.fits"),
        (("export", "aot", "im.fits", "--out", "small.toml"), "small.toml"),
        (("export", "pyrtc", "im.fits", "--out", "."), "pyrtc.yaml"),
        (("import", "aot", "im.fits", "razor-shwfs", "--out", "im.fits"), "im.fits"),
        (("import", "aot", "a", "razor-shwfs", "--out", "x", "--telemetry", "small.toml"), "small.toml"),
        (("import", "arrays", "m.toml", "razor-shwfs", "--out", "m.toml"), "m.toml"),
        (("import", "pyrtc", "p.yaml", "razor-shwfs", "--out", "p.yaml"), "p.yaml"),
        (("import", "milk", "image", "--out", "small.toml"), "small.toml"),
        (("import", "pyrtc-stream", "image", "--out", "small.toml"), "small.toml"),
        (("camera", "snap", "razor-shwfs", "--out", "frames.fits"), "frames.fits"),
        (("camera", "snap", "razor-shwfs", "--out", "frames.fits"), "frames.partial.fits"),
        (("config", "init", "small", "--out", "small.toml"), "small.toml"),
        (("report", "run", "--picture", "small.toml"), "small.toml"),
        (("night-log", "--out", "night.html"), "night.html"),
        (("gui", "razor-shwfs", "--screenshot", "small.toml"), "small.toml"),
        (("replay", "im.fits", "--screenshot", "im.fits"), "im.fits"),
    ],
)
def test_a_file_that_exists_is_not_overwritten(escape, tmp_path, monkeypatch, words, file):
    monkeypatch.chdir(tmp_path)
    (tmp_path / file).write_text("of somebody")
    code, _, err = escape(*words)
    assert (code, err) == (2, f"error: {file}: exists already; choose another name or remove it first\n")
    assert [path.name for path in tmp_path.iterdir()] == [file]
    assert (tmp_path / file).read_text() == "of somebody"


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("calibrate", "REVOLT-SHWFS"), "revolt-shwfs"),
        (("reproduce", "REVOLT"), "revolt"),
        (("reproduce", "revolt-shwf"), "revolt"),
        (("CALIBRATE",), "calibrate"),
    ],
)
def test_capitals_do_not_keep_a_name_from_being_suggested(document, words, meant):
    code, found, _ = document(*words)
    assert code == 2
    assert f"did you mean '{meant}'" in found["error"]["message"].lower()


def test_matrix_of_a_simulation_is_refused_on_hardware(escape, bench, tmp_path):
    path = save_matrix(tmp_path / "sim.fits", fake.calibration("escape"), fake.ORIGIN)
    hardware = ("--mode", "hardware", "--set", 'devices.screen.driver="manual"')
    code, _, err = escape("loop", "razor-shwfs", "--im", path, *hardware)
    assert code == 2, err
    assert not bench.benches
    assert "simulation" in err


def test_matrix_of_another_layout_is_refused(escape, bench, tmp_path):
    result = fake.calibration("escape")
    rows = "devices.dm.layout=rows:5,7,9,11,11,11,11,11,9,7,5"
    table = tmp_path / "positions.txt"
    at = load_system("razor-shwfs").devices.dm.positions()
    np.savetxt(table, at * 1.5e-3)
    same = (f"devices.dm.layout=positions:{table}", "devices.dm.position_unit=metre")
    np.savetxt(tmp_path / "turned.txt", at[::-1])
    other = (f"devices.dm.layout=positions:{tmp_path / 'turned.txt'}",)
    for overrides, refused in (((rows,), False), (same, False), (other, True)):
        text = load_system("razor-shwfs", overrides=overrides).to_toml()
        path = save_matrix(tmp_path / "im.fits", result, replace(fake.ORIGIN, config_text=text))
        config = load_system("razor-shwfs")
        if not refused:
            assert load_fitting_matrix(path, config).matrix.n_modes == config.basis.n_modes
            continue
        code, _, err = escape("loop", "razor-shwfs", "--im", path)
        assert code == 2
        assert "was measured with the layout 'points:" in err.replace("\n", " ")
        assert "with other positions: measure the matrix again" in " ".join(err.split())
        assert not bench.benches


def test_damaged_matrix_is_refused(document, bench, im):
    content = bytearray(im.read_bytes())
    content[len(content) // 2] ^= 4
    im.write_bytes(content)
    code, found, err = document("loop", "razor-shwfs", "--im", im)
    assert (code, found["error"]["type"]) == (2, "ProductError")
    assert "im.fits: damaged" in err


def test_unwritable_folder_exits_2_before_anything_opens(document, bench, tmp_path):
    (tmp_path / "file").write_text("")
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "file" / "run")
    assert (code, found["error"]["type"]) == (2, "StorageError")
    assert "--out chooses the folder of a run" in err
    assert not bench.benches


def test_hosts_that_do_not_answer_are_named(escape, monkeypatch):
    monkeypatch.setattr("escape_hw.runtime.host.discovery.discover", lambda hosts: [])
    code, _, err = escape("discover", "--host", "a", "--host", "b:5")
    assert (code, "none answers on a, b:5" in " ".join(err.split())) == (1, True)


def test_a_run_that_can_be_resumed_is_shown_with_the_way_to_go_on(document, escape, tmp_path):
    (tmp_path / "run.state").touch()
    command = f"escape calibrate --resume {tmp_path}"
    code, found, _ = document("show", tmp_path)
    assert (code, found["resume"]) == (0, command)
    assert f"not finished and has no result; resume with: {command}" in escape("show", tmp_path)[1]


def test_a_calibration_that_came_to_its_end_is_not_resumed_but_shown(document, bench, tmp_path):
    run = tmp_path / "run"
    assert document("calibrate", "razor-shwfs", "--out", run)[0] == 0
    (run / "report.html").touch()
    code, found, _ = document("calibrate", "--resume", run)
    assert code == 2
    assert str(run / "report.html") in found["error"]["message"]
    assert f"escape show {run}" in found["error"]["message"]
