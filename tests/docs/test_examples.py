"""Every example runs as a reader would run it, with the expected output."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from pages import call

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, folder: Path, *arguments: str) -> str:
    """Standard output of an example that must end well, run in an empty folder."""
    done = call([sys.executable, str(EXAMPLES / name), *arguments], folder)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout


def number(pattern: str, text: str) -> float:
    match = re.search(pattern, text)
    assert match, f"{pattern!r} is not in: {text}"
    return float(match.group(1))


def test_every_example_is_tested() -> None:
    tested = set(re.findall(r'run\(\s*"([a-z_]+\.py)"', Path(__file__).read_text()))
    assert {path.name for path in EXAMPLES.glob("*.py")} == tested


def test_poke_an_actuator(tmp_path: Path) -> None:
    out = run("poke_an_actuator.py", tmp_path)
    assert "unchanged by the guard: True" in out
    assert "requested 5.0, sent 0.8" in out
    assert "rejected: dm: actuator 48 is nan" in out
    assert 0.1 < number(r"largest slope: ([\d.]+) pixels", out) < 2.0
    picture = out.splitlines()[-24:]
    rows = [number for number, line in enumerate(picture) if "@" in line]
    assert rows, "the map shows no peak"
    assert 6 <= min(rows) <= max(rows) <= 14  # the middle, less 0.7 sub-apertures of shift


def test_grab_frames(tmp_path: Path) -> None:
    out = run("grab_frames.py", tmp_path, "kept.npz")
    assert "100 frames of 400 x 400 pixels" in out
    assert number(r"measured ([\d.]+) Hz", out) == pytest.approx(400.0, abs=1.0)
    with np.load(tmp_path / "kept.npz") as kept:
        assert kept["frames"].shape == (100, 400, 400)
        assert kept["frames"].dtype == np.uint16
        assert (np.diff(kept["index"]) >= 1).all()
        assert (np.diff(kept["arrived_s"]) > 0).all()


@pytest.mark.slow
def test_calibrate(tmp_path: Path) -> None:
    out = run("calibrate.py", tmp_path)
    assert "SPRINT converged" in out
    assert number(r"median ([\d.]+)\n", out) > 10
    for method in ("DO-CRIME", "ESCAPE"):
        assert number(rf"{method} against push-pull: .*correlation ([\d.]+)", out) > 0.95
    assert number(r"shift_x: +(-?[\d.]+)", out) == pytest.approx(-16.0, abs=1.0)
    assert number(r"shift_y: +(-?[\d.]+)", out) == pytest.approx(-71.0, abs=1.0)
    assert number(r"rotation: +(-?[\d.]+)", out) == pytest.approx(-0.77, abs=0.05)
    assert number(r"radial_scaling: +(-?[\d.]+)", out) == pytest.approx(2.9, abs=0.15)


@pytest.mark.slow
def test_close_the_loop(tmp_path: Path) -> None:
    out = run("close_the_loop.py", tmp_path, "kept.fits")
    assert (tmp_path / "kept.fits").is_file()
    assert "kept.fits: escape, 94 modes" in out
    assert "stable" in out
    for way in ("peak", "otf", "encircled"):
        # Without correction it is below one percent (D/r0 = 22).
        assert 5 < number(rf"Strehl ratio, {way}: ([\d.]+) ±", out) < 100


@pytest.mark.slow
def test_own_procedure(tmp_path: Path) -> None:
    out = run("own_procedure.py", tmp_path)
    response = [float(value) for value in re.findall(r"response ([\d.]+)", out)]
    assert len(response) == 9
    assert response[0] == 1.0
    assert all(0.9 < value < 1.2 for value in response)


def test_own_device(tmp_path: Path) -> None:
    out = run("own_device.py", tmp_path)
    outcomes = re.findall(r"^ *(\w+)  check_", out, re.MULTILINE)
    assert set(outcomes) <= {"passed", "skipped"}
    assert len(re.findall(r"passed  check_mirror", out)) > 15
    assert len(re.findall(r"passed  check_camera", out)) > 15
    assert "Acme 640: frame of (512, 640), darkest pixel 1" in out
    assert "Acme 97: requested 0.9, sent 0.500" in out
    assert 50 <= number(r"Acme 640 as science: darkest pixel (\d+)", out) < 66
