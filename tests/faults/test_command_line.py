"""Wrong input and failing devices through the real command line, on the real twin."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import document, escape
from small_bench import small
from small_system import SMALL, configuration

from escape_hw import register_device
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.config import registry
from escape_hw.io.fits.matrix import load_matrix, save_matrix
from escape_hw.io.fits.run_state import STATE_FILE
from escape_hw.io.provenance import Provenance
from escape_hw.testing import FaultyCamera, FaultyMirror
from escape_sim.devices import twins as devices

__all__ = ["document", "escape"]


@pytest.fixture
def run(document, monkeypatch, tmp_path):
    """Run a command with ``--json``: exit code, document, standard error."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", lambda folder: folder)

    def call(*words: object) -> tuple[int, dict, str]:
        code, answer, err = document(*words)
        assert "Traceback" not in err
        return code, answer, err

    return call


@pytest.fixture
def nothing_opens(monkeypatch):
    """Fail when any device is opened."""
    monkeypatch.setattr("escape_hw.bench.Bench.open", lambda self: pytest.fail("something was opened"))


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    """The small bench as a system file."""
    path = tmp_path_factory.mktemp("system") / "small.toml"
    path.write_text(configuration().to_toml())
    return path


@pytest.fixture(scope="module")
def im(good, tmp_path_factory):
    """A good matrix as a product."""
    origin = Provenance(configuration().to_toml(), "kl", 1)
    return save_matrix(tmp_path_factory.mktemp("im") / "im.fits", good.run.result, origin)


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """The folder of an interrupted DO-CRIME run of the small bench."""
    folder = tmp_path_factory.mktemp("interrupted")
    (folder / "config.toml").write_text(configuration().to_toml())
    request = {"method": "docrime", "frames": 300, "whiten": True}
    checkpoint = Checkpoint(folder / STATE_FILE, request=request)
    with small() as bench:
        settings = {"poke": bench.config.calibration.poke, "whiten": True, "correlations": False}
        checkpoint.begin(bench, "docrime", build_modal_basis(bench), settings)
        checkpoint.save({}, {}, None)
    return folder


SETTINGS = [
    ("loop.gian=0.3", "loop.gain"),
    ("twin.registration.shift_z=1", "twin.registration.shift_"),
    ("loop.gain=0", "0 < x <= 2"),
    ("loop.gain=-0.1", "0 < x <= 2"),
    ("loop.gain=2.5", "0 < x <= 2"),
    ("loop.gain=nan", "loop.gain"),
    ("loop.gain=inf", "loop.gain"),
    ("loop.gain=high", "loop.gain"),
    ("loop.gain", "loop.gain"),
    ("loop.dropped_modes=30", "dropped_modes"),
    ("calibration.frames=0", "calibration.frames"),
    ("calibration.poke=0", "calibration.poke"),
    ("calibration.poke=nan", "calibration.poke"),
    ("devices.dm.limits.disabled=[37]", "0 to 36"),
    ("devices.dm.limits.max_stroke=1.5", "max_stroke"),
    ("devices.wfs.exposure_s=0.1", "longer than a frame"),
    ("basis.n_modes=38", "37 actuators"),
]


@pytest.mark.usefixtures("nothing_opens")
@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("calibrate", "razor-shwsf"), "razor-shwfs"),
        (("calibrate", "no-such-file.toml"), "no-such-file.toml"),
        *((("calibrate", "SYSTEM", "--set", setting), match) for setting, match in SETTINGS),
        (("calibrate", "SYSTEM", "--modes", "0"), "modes"),
        (("calibrate", "SYSTEM", "--frames", "0"), "frames"),
        (("calibrate", "SYSTEM", "--frames", "-5"), "frames"),
        (("calibrate", "SYSTEM", "--poke", "0"), "--poke"),
        (("calibrate", "SYSTEM", "--poke", "-0.02"), "--poke"),
        (("calibrate", "SYSTEM", "--poke", "2"), "--poke"),
        (("calibrate", "SYSTEM", "--poke", "nan"), "--poke"),
        (("calibrate", "SYSTEM", "--seed", "-1"), "seed"),
        (("calibrate", "SYSTEM", "--mode", "metal"), "mode"),
        (("loop", "SYSTEM", "--im", "IM", "--gain", "0"), "gain"),
        (("loop", "SYSTEM", "--im", "IM", "--gain", "-1"), "gain"),
        (("loop", "SYSTEM", "--im", "IM", "--gain", "nan"), "gain"),
        (("loop", "SYSTEM", "--im", "IM", "--leak", "1.5"), "leak"),
        (("loop", "SYSTEM", "--im", "IM", "--leak", "nan"), "leak"),
        (("loop", "SYSTEM", "--im", "IM", "--dropped-modes", "30"), "dropped_modes"),
        (("loop", "SYSTEM", "--im", "IM", "--dropped-modes", "-1"), "dropped-modes"),
        (("loop", "SYSTEM", "--im", "IM", "--frames", "0"), "frames"),
        (("loop", "SYSTEM", "--im", "absent.fits"), "absent.fits"),
        (("loop", "SYSTEM", "--im", "SYSTEM"), "not a FITS file"),
        (("sprint", "SYSTEM", "--im", "SYSTEM"), "not a FITS file"),
        (("sweep", "SYSTEM", "--sampler", "best"), "--sampler best: unknown; it is one of random, tpe"),
        (("sweep", "SYSTEM", "--metric", "best"), "--metric best: unknown; it is one of peak"),
        (("sweep", "SYSTEM", "--margin", "0"), "--margin 0: it must be positive"),
        (("sweep", "SYSTEM", "--gains", "gains.fits"), "--gains needs --im"),
        (("sweep", "SYSTEM", "--im", "IM", "--gains", "absent.fits"), "absent.fits"),
        (("sweep", "SYSTEM", "--im", "IM", "--im", "IM"), "two of the matrices have files of the same name"),
        (("sweep", "SYSTEM", "--gain", "0.1:9"), "out of range (allowed range 0 < x <= 2)"),
        (("sweep", "SYSTEM", "--gain", "0.1,9,0.2"), "out of range (allowed range 0 < x <= 2)"),
        (("sweep", "SYSTEM", "--delay", "late"), "delay: late must be a number of frames"),
        (("sweep", "SYSTEM", "--calibration-frames", "50"), "at least 82 frames"),
        (("sweep", "SYSTEM", "--storage", "foo://bar"), "--storage foo://bar: Can't load plugin"),
        (("sweep", "SYSTEM", "--scheduler", "nowhere"), "--scheduler"),  # it, or Dask, is not there
        (("sweep", "--resume", "RUN"), "sweep.json: cannot be read"),
        (("flat", "SYSTEM"), "no dark frame"),
        (("calibrate", "SYSTEM", "--frames", "12"), "at least 13 frames"),
        (("calibrate", "SYSTEM", "--frames", "50", "--snr", "3"), "no signal-to-noise ratio"),
        (("calibrate", "SYSTEM", "--frames", "50", "--estimator", "matrix"), "at least 82 frames"),
        (("calibrate", "SYSTEM", "--frames", "50", "--method", "docrime"), "at least 82 frames"),
        (("calibrate", "SYSTEM", "--frames", "50", "--method", "push-pull-fast"), "at least 82 frames"),
        (("calibrate", "SYSTEM", "--frames", "2", "--method", "modulated"), "use more frames"),
        (("calibrate", "SYSTEM", "--set", "calibration.frames=50", "--method", "docrime"), "at least 82"),
        (("calibrate", "--resume", "RUN", "--set", "loop.gain=0.31"), "this run's in loop.gain;"),
        (("calibrate", "--resume", "RUN", "--poke", "0.01"), "its poke is 0.02, this run's is 0.01"),
        (("calibrate", "--resume", "RUN", "--no-whiten"), "its whiten is True, this run's is False"),
        (("calibrate", "--resume", "RUN", "--closed-loop", "IM"), "its control matrix is None"),
        (("calibrate", "--resume", "RUN", "--method", "escape"), "its method is 'docrime'"),
        (("calibrate", "maps-nir", "--resume", "RUN"), "its system is 'razor-shwfs', this run's is"),
    ],
)
def test_refused_with_exit_2_before_anything_is_opened(run, system, im, interrupted, words, match):
    stands_for = {"SYSTEM": system, "IM": im, "RUN": interrupted}
    code, document, err = run(*(stands_for.get(word, word) for word in words))
    assert code == 2
    assert match in document["error"]["message"]
    assert match in err


def test_unknown_model_and_driver(run, system, tmp_path):
    code, document, _ = run("calibrate", system, "--set", "calibration.model=fats", "--out", tmp_path / "a")
    assert code == 2
    assert "'fats'" in document["error"]["message"]
    assert "fast" in document["error"]["message"]
    code, document, _ = run("calibrate", system, "--set", "devices.wfs.sim_driver=sim-ximae")
    assert code == 2
    assert "sim-ximea" in document["error"]["message"]


@pytest.mark.usefixtures("nothing_opens")
def test_a_matrix_of_another_system_basis_or_mirror(run, system, good, tmp_path):
    own = Provenance(configuration().to_toml(), "kl", 1)

    def refused(name: str, *sets: str, origin: Provenance = own, command: str = "loop", **changes: object):
        matrix = replace(good.matrix, **changes)
        path = save_matrix(tmp_path / f"{name}.fits", replace(good.run.result, matrix=matrix), origin)
        words = [word for key in sets for word in ("--set", key)]
        code, document, _ = run(command, system, "--im", path, *words)
        assert code == 2
        assert document["error"]["type"] == "IncompatibleProduct"
        return document["error"]["message"]

    assert "'maps-nir'" in refused("a", system="maps-nir")
    assert "'maps-nir'" in refused("b", command="sprint", system="maps-nir")
    assert "kind of basis" in refused("c", origin=replace(own, basis="zonal"))
    assert "number of modes" in refused("d", "basis.n_modes=25")
    assert "number of actuators" in refused("e", m2c=good.matrix.m2c[:-1])
    assert "number of actuators" in refused("f", command="sprint", m2c=good.matrix.m2c[:-1])


def test_a_matrix_of_another_camera_region(run, system, im, tmp_path):
    words = ("--set", "devices.wfs.region=[220,156,187,187]", "--no-strehl", "--out", tmp_path / "run")
    code, document, _ = run("loop", system, "--im", im, *words)
    assert code == 2
    assert document["error"]["type"] == "IncompatibleProduct"
    assert "beyond the camera's region" in document["error"]["message"]


@pytest.mark.usefixtures("nothing_opens")
@pytest.mark.parametrize("command", ["loop", "sprint", "show", "compare"])
def test_truncated_and_flipped_products(run, system, im, command, tmp_path):
    content = im.read_bytes()
    damaged = tmp_path / "damaged.fits"
    words = {
        "loop": ("loop", system, "--im", damaged),
        "sprint": ("sprint", system, "--im", damaged),
        "show": ("show", damaged),
        "compare": ("compare", im, damaged),
    }[command]

    def refused(changed: bytes) -> None:
        damaged.write_bytes(changed)
        code, document, err = run(*words)
        assert (code, document["error"]["type"]) == (2, "ProductError")
        assert "damaged.fits: " in err

    for size in (0, 1, 80, 2879, 2880, len(content) // 2, len(content) // 5760 * 2880, len(content) - 2880):
        refused(content[:size])
    rng = np.random.default_rng(5)
    for place in (0, 9, 81, *rng.integers(0, len(content), 12)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(0, 7))
        refused(bytes(flipped))


@pytest.mark.parametrize(
    "name",
    [
        "docrime",
        "push-pull",
        "loop",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("escape", "reproduce")),
    ],
)
def test_a_failed_camera_and_a_lost_mirror_exit_3(run, system, im, tmp_path, monkeypatch, name):
    monkeypatch.setattr(registry, "_REGISTERED", {})
    opened = []

    def dying_camera(section, context):
        opened.append(context.shared)
        return FaultyCamera(devices.make_wfs_camera(section, context), stall_from=60)

    def dying_mirror(section, context):
        return FaultyMirror(devices.make_mirror(section, context), lost_from=20)

    register_device("dying-camera", dying_camera)
    register_device("dying-mirror", dying_mirror)
    commands = {
        "docrime": ("calibrate", system, "--method", "docrime", "--frames", 300),
        "push-pull": ("calibrate", system, "--method", "push-pull", "--frames", 3),
        "escape": ("calibrate", system, "--frames", 300),
        "loop": ("loop", system, "--im", im, "--frames", 300, "--no-strehl"),
        "reproduce": ("reproduce", "shwfs", "--system", system, "--frames", 300, "--loop-frames", 100),
    }
    words, out = commands[name], tmp_path / "camera"
    code, document, err = run(*words, "--out", out, "--set", "devices.wfs.sim_driver=dying-camera")
    assert (code, document["error"]["type"]) == (3, "FrameTimeout"), name
    assert "wfs: no frame within 1 s" in err
    assert "FrameTimeout" in (out / "run.log").read_text()
    assert not list(out.glob("*.fits"))
    dynamics = opened[-1]["simulated bench"].dynamics
    dynamics.mean(dynamics._time, dynamics._time + 1)
    assert not dynamics._target.any()
    code, document, err = run(
        *words, "--out", tmp_path / "mirror", "--set", "devices.dm.sim_driver=dying-mirror"
    )
    assert (code, document["error"]["type"]) == (3, "DeviceLost"), name
    assert "dm: lost" in err
    # It could not be flattened any more: that is said.
    assert "closing dm" in err


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("sensor", r"sensor: \d+ sub-apertures, .* counts per frame in a bright one, background .* counts"),
        ("model-psf", r"PSF of the flat mirror without turbulence: peak .* counts, total .* counts"),
        ("dark", r"dark frame: mean .* counts, scatter .* counts rms over the pixels"),
    ],
)
def test_a_result_of_a_few_numbers_is_printed(escape, system, tmp_path, command, words):
    code, text, _ = escape(command, system, "--frames", 5, "--out", tmp_path / "run")
    assert code == 0
    file = "dark: .*/dark.fits" if command == "dark" else "result: .*/run/result.json"
    assert re.search(f"^SIMULATED *\n{words}\n{file}\n$", text)


def test_no_light_and_no_response_exit_1(run, system, tmp_path):
    dark = ("--set", "twin.wfs.photons_per_frame=1")
    code, document, _ = run("calibrate", system, "--frames", 300, *dark, "--out", tmp_path / "b")
    assert (code, document["error"]["type"]) == (1, "CalibrationError")
    assert "no illuminated pupil" in document["error"]["message"]
    still = ("--set", "devices.dm.stroke_m=1e-12")
    code, document, _ = run("calibrate", system, "--frames", 300, *still, "--out", tmp_path / "c")
    assert (code, document["error"]["type"]) == (1, "CalibrationError")
    assert "does not respond" in document["error"]["message"]


@pytest.mark.slow
def test_one_percent_of_lost_frames_changes_no_registration(run, system, tmp_path):
    found = {}
    for loss in (0.0, 0.01):
        lossy = ("--set", f"twin.loss_probability={loss}", "--frames", 600, "--out", tmp_path / str(loss))
        code, document, err = run("calibrate", system, *lossy)
        assert code == 0, err
        assert document["converged"]
        found[loss] = document["registration"]
        product = load_matrix(document["products"]["im"])
        assert (product.result.lost_frames > 0) == (loss > 0)
    for name, value in found[0.0].items():
        other = found[0.01][name]
        assert abs(value["value"] - other["value"]) < 4 * np.hypot(value["sigma"], other["sigma"]), name


@pytest.mark.slow
def test_the_same_command_twice_gives_the_same_numbers(run, tmp_path):
    sets = [word for key in SMALL for word in ("--set", key)]
    found = []
    for name in ("a", "b"):
        code, document, err = run(
            "calibrate", "razor-shwfs", *sets, "--frames", 300, "--seed", 11, "--out", tmp_path / name
        )
        assert code == 0, err
        product = load_matrix(document["products"]["docrime"])
        found.append((document["registration"], document["gain"], product.matrix.data, product.matrix.sigma))
    assert found[0][:2] == found[1][:2]
    np.testing.assert_array_equal(found[0][2], found[1][2])
    np.testing.assert_array_equal(found[0][3], found[1][3])
