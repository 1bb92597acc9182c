"""The command line keeps its promises: exit codes, one JSON document, nothing lost on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fake_bench
import fake_results as fake
import pytest

from escape_hw.cli import main
from escape_hw.errors import CalibrationError, DeviceLost
from escape_hw.io.fits import load_matrix, save_matrix
from escape_hw.io.provenance import Provenance
from escape_hw.io.psf import load_loop, save_loop
from escape_hw.report.build import write_report

ORIGIN = Provenance(basis="kl", seed=1)
REGISTRATION = {"shift_x", "shift_y", "rotation", "radial_scaling", "tangential_scaling"}


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Fake devices and procedures, and no time spent on figures."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("escape_hw.runtime.keep.write_report", lambda folder: folder)
    return fake_bench.install(monkeypatch)


@pytest.fixture
def reports(bench, monkeypatch):
    """The real report after all."""
    monkeypatch.setattr("escape_hw.runtime.keep.write_report", write_report)


@pytest.fixture
def escape(capsys):
    """Run the command; returns exit code, standard output and standard error."""

    def call(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return call


@pytest.fixture
def document(escape):
    """Run with ``--json``: exit code, the only document, standard error."""

    def call(*words: object) -> tuple[int, dict, str]:
        code, out, err = escape(*words, "--json")
        return code, json.loads(out, parse_constant=pytest.fail), err

    return call


@pytest.fixture
def im(tmp_path):
    return save_matrix(tmp_path / "im.fits", fake.calibration("escape"), ORIGIN)


def test_help_is_quick_and_light():
    script = (
        "import sys, escape_hw.cli.app as a\n"
        "heavy = {'numpy', 'scipy', 'astropy', 'matplotlib', 'pydantic', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "a.run(['--help'])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for command in (
        "systems", "config", "calibrate", "sprint", "loop", "reproduce", "show", "compare", "report", "perf",
    ):  # fmt: skip
        assert command in done.stdout


def test_systems_lists_the_bundled_one(escape, document):
    assert "razor-shwfs" in escape("systems")[1]
    code, found, _ = document("systems")
    assert code == 0
    assert found["systems"][0]["n_act"] == 97
    assert {"schema", "system", "simulated", "seed"} <= set(found)


def test_config_check_init_schema(escape, document, tmp_path):
    file = tmp_path / "mine.toml"
    assert escape("config", "init", "mine", "--out", file)[0] == 0
    assert escape("config", "init", "mine", "--out", file)[0] == 2  # never overwritten
    code, found, _ = document("config", "check", file)
    assert (code, found["valid"], found["system"]) == (0, True, "mine")
    code, found, err = document("config", "check", file, "--set", "twin.registration.shift_z=1")
    assert code == 2
    assert found["error"]["type"] == "ConfigError"
    assert "did you mean 'twin.registration.shift_" in err
    assert document("config", "schema")[1]["title"] == "ESCAPE system"
    assert "[devices.dm]" in escape("config", "init")[1]


def test_calibrate_document_has_every_promised_field(document, bench, tmp_path):
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run", "--seed", 7)
    assert code == 0
    assert (found["schema"], found["system"], found["simulated"], found["seed"]) == (
        1,
        "razor-shwfs",
        True,
        7,
    )
    assert set(found["registration"]) == REGISTRATION
    assert all(set(value) == {"value", "sigma", "unit"} for value in found["registration"].values())
    assert set(found["snr"]) >= {"min", "median"}
    for name in ("frames", "sky_seconds", "gain", "iterations", "converged", "wall_seconds"):
        assert isinstance(found[name], int | float), name
    product = load_matrix(found["products"]["im"], expect_system="razor-shwfs")
    assert product.matrix.method == "escape"
    assert product.header["PARENT1"] == "docrime.fits"
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"config.toml", "run.log", "result.json", "im.fits", "docrime.fits"} <= names
    assert bench.benches[0].closed
    assert "frames" not in bench.calls[0][1]  # as configured


def test_calibrate_hands_its_options_on(escape, bench, tmp_path):
    code, _, err = escape(
        "calibrate", "razor-shwfs", "--method", "docrime", "--frames", 500, "--poke", 0.01, "--plain",
        "--modes", 50, "--set", "loop.gain=0.3", "--out", tmp_path / "run",
    )  # fmt: skip
    assert code == 0, err
    assert bench.calls == [("docrime", {"frames": 500, "poke": 0.01, "whiten": False})]
    config = bench.benches[0].config
    assert (config.basis.n_modes, config.loop.gain) == (50, 0.3)


def test_push_pull_is_measured_without_turbulence(escape, bench, tmp_path):
    assert escape("calibrate", "razor-shwfs", "--method", "push-pull", "--out", tmp_path / "run")[0] == 0
    assert bench.benches[0].screen_seen == {"push-pull": False}
    assert bench.benches[0].screen.state.inserted


def test_human_output_names_registration_and_report(escape, bench, tmp_path):
    code, out, _ = escape("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert code == 0
    for word in ("SIMULATED", "Shift X [% of Sub Aperture]", "±", "planted", "report.html"):
        assert word in out


def test_default_folder_is_dated_in_the_user_data(document, bench, tmp_path):
    _, found, _ = document("calibrate", "razor-shwfs", "--method", "docrime")
    folder = Path(found["folder"])
    assert tmp_path / "data" in folder.parents
    assert folder.name.endswith("razor-shwfs_calibrate-docrime")


def test_sprint_uses_the_measured_matrix_and_opens_nothing(document, bench, im, tmp_path):
    code, found, _ = document("sprint", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert code == 0
    assert set(found["registration"]) == REGISTRATION
    asked = {"method": "docrime-whitened", "modes": 50, "learning_rate": 1.0, "misfit": True}
    assert bench.calls == [("sprint", asked)]
    assert document("sprint", "razor-shwfs", "--im", im, "--light", "--out", tmp_path / "light")[0] == 0
    assert bench.calls[1:] == [("sprint", {**asked, "misfit": False})]
    assert not bench.benches
    product = load_matrix(found["products"]["im"])
    assert product.registration is not None
    assert product.header["PARENT1"] == "im.fits"


def test_loop_document_has_every_promised_field(document, bench, im, tmp_path):
    code, found, _ = document("loop", "razor-shwfs", "--im", im, "--frames", 400, "--out", tmp_path / "run")
    assert code == 0
    assert set(found["strehl"]) == {"peak", "otf", "encircled"}
    assert all(set(value) == {"value", "sigma"} for value in found["strehl"].values())
    assert set(found["latency_us"]) == {"p50", "p99", "max"}
    assert {"residual_rms_nm", "rate_hz", "lost_frames", "stable"} <= set(found)
    assert load_loop(found["products"]["loop"]).header["PARENT1"] == "im.fits"
    assert bench.benches[0].screen_seen == {"model_psf": False, "loop": True}
    assert bench.calls[-1][1]["frames"] == 400


def test_loop_settings_become_configuration(escape, bench, im, tmp_path):
    words = ("loop", "razor-shwfs", "--im", im, "--no-strehl", "--out", tmp_path / "run")
    assert escape(*words, "--gain", 0.2, "--leak", 0.01, "--drop", 3)[0] == 0
    loop = bench.benches[0].config.loop
    assert (loop.gain, loop.leak, loop.dropped_modes) == (0.2, 0.01, 3)
    assert escape(*words, "--best-gain")[0] == 0
    assert bench.calls[-1][1]["gain"] == 0.35
    assert escape(*words, "--best-gain", "--gain", 0.2)[0] == 2


def test_unstable_loop_and_lost_convergence_exit_1(document, bench, im, tmp_path):
    bench.changes = {"stable": False}
    code, found, _ = document("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "a")
    assert (code, found["stable"]) == (1, False)
    bench.changes = {"registration": replace(fake.registration(), converged=False)}
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "b")
    assert (code, found["converged"]) == (1, False)
    bench.changes = {}
    words = ("calibrate", "razor-shwfs", "--out", tmp_path / "c", "--accuracy")
    assert document(*words, 0.01)[0] == 1
    assert document(*words, 1.0)[0] == 0


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
        ("loop", "razor-shwfs"),
        ("loop", "razor-shwfs", "--im", "absent.fits"),
        ("show", "absent.fits"),
        ("report", "absent"),
        ("perf", "no-such-stage"),
        ("nonsense",),
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


def test_matrix_of_another_system_basis_or_mode_is_refused(escape, bench, tmp_path):
    def refused(name: str, matrix: object, origin: Provenance = ORIGIN, *more: str) -> str:
        result = fake.calibration("escape")
        path = save_matrix(tmp_path / f"{name}.fits", replace(result, matrix=matrix, measured=None), origin)
        code, _, err = escape("loop", "razor-shwfs", "--im", path, *more)
        assert code == 2, err
        assert not bench.benches
        return err

    good = fake.matrix("escape")
    assert "'maps-vis'" in refused("system", replace(good, system="maps-vis"))
    assert "modes" in refused("modes", fake.matrix("escape", n_modes=50))
    assert "basis" in refused("basis", good, Provenance(basis="zonal"))
    assert "actuators" in refused("dm", replace(good, m2c=good.m2c[:50]))
    hardware = ("--mode", "hardware", "--set", 'devices.screen.driver="manual"')
    assert "simulation" in refused("sim", good, ORIGIN, *hardware)


def test_damaged_matrix_is_refused(document, bench, im):
    content = bytearray(im.read_bytes())
    content[len(content) // 2] ^= 4
    im.write_bytes(content)
    code, found, err = document("loop", "razor-shwfs", "--im", im)
    assert (code, found["error"]["type"]) == (2, "ProductError")
    assert "im.fits: damaged" in err


def test_device_fault_exits_3_and_closes_the_bench(document, bench, tmp_path):
    def lose(name: str) -> None:
        raise DeviceLost("wfs", "no frames any more; check the cable")

    bench.hook = lose
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (3, "DeviceLost")
    assert "error: wfs: no frames any more" in err
    assert bench.benches[0].closed
    assert "DeviceLost" in (tmp_path / "run" / "run.log").read_text()


def test_failed_calibration_exits_1(document, bench, tmp_path):
    def fail(name: str) -> None:
        raise CalibrationError("the data cannot constrain the rotation")

    bench.hook = fail
    assert document("calibrate", "razor-shwfs", "--out", tmp_path / "run")[0] == 1


def test_defect_exits_3_with_its_traceback_in_the_log(document, bench, tmp_path):
    bench.hook = lambda name: 1 // 0
    code, found, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (3, "ZeroDivisionError")
    assert "run.log" in err
    assert "Traceback" not in err
    assert "Traceback" in (tmp_path / "run" / "run.log").read_text()


def test_unwritable_folder_exits_2_before_anything_opens(document, bench, tmp_path):
    (tmp_path / "file").write_text("")
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "file" / "run")
    assert (code, found["error"]["type"]) == (2, "StorageError")
    assert not bench.benches


def test_disk_full_at_the_end_exits_1_after_the_mirror_is_safe(document, bench, tmp_path, monkeypatch):
    def fill(name: str) -> None:
        def full(handle: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("escape_hw.io.storage.os.fsync", full)

    bench.hook = fill
    code, found, _ = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (1, "StorageError")
    assert bench.benches[0].closed
    assert not list((tmp_path / "run").glob("*.fits"))
    assert not list((tmp_path / "run").glob(".*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
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
    assert "stopping" in err
    assert bench.benches[0].closed
    assert bench.benches[0].screen.state.inserted
    assert signal.getsignal(number) is before
    assert json.loads((tmp_path / "run" / "result.json").read_text())["partial"] is True


def test_ctrl_c_in_the_loop(document, bench, im, tmp_path):
    bench.hook = lambda name: name == "closed_loop" and os.kill(os.getpid(), signal.SIGINT)
    code, found, _ = document("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert code == 130
    assert load_loop(found["products"]["loop"]).result.partial
    assert bench.benches[0].closed


def test_ctrl_c_before_anything_was_measured(document, bench, im, tmp_path):
    bench.hook = lambda name: name == "model_psf" and os.kill(os.getpid(), signal.SIGINT)
    code, found, _ = document("loop", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert (code, found["error"]["type"]) == (130, "Aborted")
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


def test_library_chatter_never_reaches_standard_output(document, bench, tmp_path):
    bench.hook = lambda name: print("chatter")
    code, _, err = document("calibrate", "razor-shwfs", "--out", tmp_path / "run")
    assert code == 0
    assert "chatter" in err


def test_quiet_shows_no_progress(escape, bench, tmp_path):
    assert (
        "docrime: " in escape("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "a")[2]
    )
    words = ("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "b", "--quiet")
    assert escape(*words)[2] == ""


@pytest.mark.usefixtures("reports")
def test_reproduce_shwfs_shows_registration_strehl_and_report(escape, bench, tmp_path):
    run = tmp_path / "run"
    code, out, err = escape("reproduce", "shwfs", "--out", run, "--loop-frames", 321, "--plants", 0)
    assert code == 0, err
    for word in ("planted", "Shift Y", "push-pull", "DO-CRIME", "ESCAPE", "OTF", "±"):
        assert word in out
    assert out.strip().splitlines()[-1] == f"report: {run / 'report.html'}"
    assert bench.benches[0].screen_seen == {
        "push-pull": False,
        "escape": True,
        "model_psf": False,
        "loop": True,
    }
    loops = [options for name, options in bench.calls if name == "closed_loop"]
    assert [loop["method"] for loop in loops] == ["push-pull", "docrime-whitened", "escape"]
    assert all(loop["gain"] == 0.35 and loop["frames"] == 321 for loop in loops)
    assert bench.benches[0].config.twin.registration.shift_y == -71.0
    page = (run / "report.html").read_text()
    for word in ("SIMULATED", "SPRINT convergence", "Stacked closed-loop PSFs", "Search for each matrix"):
        assert word in page
    assert load_loop(run / "loop_escape.fits").header["PARENT1"] == "escape.fits"


def test_reproduce_judges_its_own_result(document, bench, tmp_path):
    words = ("reproduce", "shwfs", "--out", tmp_path / "run", "--plants", 0)
    code, found, _ = document(*words, "--set", "twin.registration.shift_x=30")
    assert code == 1
    failed = [check["text"] for check in found["criteria"] if not check["met"]]
    assert len(failed) == 1
    assert "planted registration" in failed[0]


def test_reproduce_table1(escape, document, bench, tmp_path):
    words = ("reproduce", "table1", "--out", tmp_path / "run", "--short", 1000, "--long", 5000)
    code, out, _ = escape(*words)
    assert code == 0
    assert "α SHORT" in out
    assert "α LONG" in out
    assert [options["frames"] for _, options in bench.calls] == [1000, 5000]
    code, found, _ = document(*words)
    assert set(found["table1"]) == {"SHORT", "LONG"}
    assert sum("agree" in check["text"] for check in found["criteria"]) == 5
    assert set(found["products"]) == {
        "docrime_short", "escape_short", "docrime_long", "escape_long", "report",
    }  # fmt: skip


@pytest.mark.parametrize("place", ["push-pull", "escape", "model_psf", "closed_loop"])
def test_ctrl_c_in_a_reproduction_keeps_what_is_done(document, bench, tmp_path, place):
    bench.hook = lambda name: name == place and os.kill(os.getpid(), signal.SIGINT)
    code, found, _ = document("reproduce", "shwfs", "--out", tmp_path / "run", "--plants", 0)
    assert code == 130
    assert found["partial"] is True
    assert found["criteria"] == []
    done = {"push-pull": 0, "escape": 1, "model_psf": 3, "closed_loop": 3}[place]
    paths = [
        Path(path) for name, path in found["products"].items() if name in ("push_pull", "docrime", "escape")
    ]
    assert sum(not path.name.endswith(".partial.fits") for path in paths) == done
    assert bench.benches[0].closed
    assert bench.benches[0].screen.state.inserted


@pytest.mark.usefixtures("reports")
def test_show_compare_report(escape, document, im, tmp_path):
    assert "SHA-256" in escape("show", im)[1]
    code, found, _ = document("show", im)
    assert (code, found["header"]["KIND"], found["metrics"]["poke"]) == (0, "IM", 0.02)
    psf = save_loop(tmp_path / "psf.fits", fake.loop(), "razor-shwfs", True, ORIGIN)
    assert document("show", psf)[1]["strehl"]["peak"]["value"] == 0.62
    other = save_matrix(tmp_path / "b.fits", fake.calibration("push-pull"), ORIGIN)
    code, found, _ = document("compare", im, other)
    assert code == 0
    assert len(found["correlation"]) == 94
    assert found["correlation"][50] > 0.99
    assert found["registration_difference"] is None
    assert "relative rms difference" in escape("compare", im, im)[1]
    run = Path(
        document("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "run")[1]["folder"]
    )
    before = (run / "report.html").read_text()
    moved = run.rename(tmp_path / "moved")
    (moved / "report.html").unlink()
    code, found, _ = document("report", moved)
    assert (code, found["report"]) == (0, str(moved / "report.html"))
    # The run's log, shown in the report, has grown since; the figures are the same to the byte.
    assert (moved / "report.html").read_text().split("<h2>Origin")[0] == before.split("<h2>Origin")[0]
    assert document("show", moved)[1]["command"] == "calibrate"
    # A calibration alone has no image to draw.
    code, _, err = escape("report", moved, "--picture", tmp_path / "picture.png")
    assert code == 2
    assert "holds no matrix or no closed-loop image" in err
