"""Every command passes on its options, and its document has every documented field."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import fake_results as fake

from escape_hw.calibration.sprint.normal_equations import Priors
from escape_hw.io.fits.loop import load_loop
from escape_hw.io.fits.matrix import load_matrix

REGISTRATION = {"shift_x", "shift_y", "rotation", "radial_scaling", "tangential_scaling"}


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
        "systems", "config", "calibrate", "sprint", "gains", "loop", "track", "reproduce", "show", "compare",
        "report", "influence", "perf", "dm", "camera", "asm", "doctor", "discover", "udev", "emulate",
    ):  # fmt: skip
        assert command in done.stdout


def test_systems_lists_the_bundled_one(escape, document):
    assert "razor-shwfs" in escape("systems")[1]
    code, found, _ = document("systems")
    assert code == 0
    assert {row["name"]: row["n_act"] for row in found["systems"]}["razor-shwfs"] == 97
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


def test_calibrate_document_has_every_documented_field(document, bench, tmp_path):
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


def test_calibrate_passes_its_options_on(escape, bench, tmp_path):
    code, _, err = escape(
        "calibrate", "razor-shwfs", "--method", "docrime", "--frames", 500, "--poke", 0.01, "--no-whiten",
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
    for word in ("SIMULATED", "Shift X [% of Sub Aperture]", "±", "injected", "report.html"):
        assert word in out


def test_sprint_uses_the_measured_matrix_and_opens_nothing(document, bench, im, tmp_path):
    code, found, _ = document("sprint", "razor-shwfs", "--im", im, "--out", tmp_path / "run")
    assert code == 0
    assert set(found["registration"]) == REGISTRATION
    asked = {
        "method": "docrime-whitened",
        "modes": 94,
        "learning_rate": 1.0,
        "solver": "mixed-effects",
        "modes_choice": "snr",
        "loss": "squares",
        "actuator_model": "fitted",
        "extra_parameters": (),
        "usual_priors": Priors(),
    }
    assert bench.calls == [("sprint", asked)]
    assert (
        document(
            "sprint", "razor-shwfs", "--im", im, "--solver", "registration-only", "--out", tmp_path / "light"
        )[0]
        == 0
    )
    assert bench.calls[1:] == [("sprint", {**asked, "solver": "registration-only"})]
    assert not bench.benches
    product = load_matrix(found["products"]["im"])
    assert product.registration is not None
    assert product.header["PARENT1"] == "im.fits"
    synthetic = load_matrix(found["products"]["escape"])
    assert synthetic.matrix.method == "escape"
    assert synthetic.registration is not None


def test_loop_document_has_every_documented_field(document, bench, im, tmp_path):
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
    assert escape(*words, "--gain", 0.2, "--leak", 0.01, "--dropped-modes", 3)[0] == 0
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


def test_with_fewer_modes_the_loop_drops_its_usual_share(escape, bench, tmp_path):
    words = ("calibrate", "razor-shwfs", "--method", "docrime", "--out", tmp_path / "run", "--modes")
    for modes, more, dropped in ((5, (), 0), (50, (), 7), (94, (), 14), (5, ("loop.dropped_modes=2",), 2)):
        code, _, err = escape(*words, modes, *(word for text in more for word in ("--set", text)))
        assert code == 0, err
        config = bench.benches[-1].config
        assert (config.basis.n_modes, config.loop.dropped_modes) == (modes, dropped)
        assert (f"becomes {dropped} with {modes} modes" in err) == (dropped != 14 and not more)
    code, _, err = escape(*words, 5, "--set", "loop.dropped_modes=5")
    assert code == 2
    assert "leaves none of the 5 modes; lower it" in err
    assert escape(*words, 98)[0] == 2
