"""Source distribution and wheel, built, installed into an empty environment and used."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import escape_hw

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


def run(*command: str, cwd: Path) -> str:
    """Run a program without this environment's paths and packages."""
    kept = {key: value for key, value in os.environ.items() if key.startswith("PIP_")}
    kept |= {key: value for key, value in os.environ.items() if key.lower().endswith("_proxy")}
    kept |= {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
    own = {"XDG_DATA_HOME": str(cwd / "data"), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        command, cwd=cwd, env=kept | own, capture_output=True, text=True, check=False, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(target: str, source: Path, folder: Path) -> Path:
    run(sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder), cwd=source)
    (made,) = folder.iterdir()
    return made


def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution."""
    return build("sdist", ROOT, tmp_path_factory.mktemp("source") / "sdist")


@pytest.fixture(scope="module")
def unpacked(sdist: Path) -> Path:
    """Folder of the unpacked source distribution."""
    folder = sdist.parent.parent
    with tarfile.open(sdist) as archive:
        # Python before 3.11.4 has no filters, Python 3.12 and 3.13 warn without one.
        safely = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        archive.extractall(folder / "unpacked", **safely)
    (found,) = (folder / "unpacked").iterdir()
    return found


@pytest.fixture(scope="module")
def wheel(unpacked: Path) -> Path:
    """Wheel built from the source distribution."""
    return build("wheel", unpacked, unpacked.parent / "wheel")


def test_the_source_distribution_is_complete(unpacked: Path, wheel: Path, tmp_path: Path) -> None:
    assert unpacked.name == f"escape_hw-{escape_hw.__version__}"
    for name in ("CHANGELOG.md", "LICENSE", "constraints.txt", "tests/conftest.py", "docs/index.md"):
        assert (unpacked / name).is_file(), name
    assert names(wheel) == names(build("wheel", ROOT, tmp_path / "checkout"))


def install(python: str, source: Path, folder: Path) -> Path:
    """Install a distribution in the tested versions into an empty environment; returns its programs."""
    run(python, "-m", "venv", str(folder / "venv"), cwd=folder)
    programs = folder / "venv" / "bin"
    pip = (str(programs / "python"), "-m", "pip", "--disable-pip-version-check", "install", "--quiet")
    run(*pip, "--constraint", str(ROOT / "constraints.txt"), str(source), cwd=folder)
    return programs


def test_the_source_distribution_installs_into_an_empty_environment(sdist: Path, tmp_path: Path) -> None:
    """As pip does it: it builds the wheel itself, with the build requirements that it downloads."""
    escape = str(install(sys.executable, sdist, tmp_path) / "escape")
    assert run(escape, "--version", cwd=tmp_path).split() == ["escape", escape_hw.__version__]
    poked = json.loads(
        run(escape, "dm", "poke", "razor-shwfs", "48", "0.05", "--seconds", "0", "--json", cwd=tmp_path)
    )
    assert poked["peak"] == 0.05


@pytest.mark.parametrize("minor", [11, 12, 13])
def test_the_wheel_installs_into_an_empty_environment(minor: int, wheel: Path, tmp_path: Path) -> None:
    python = runpy.run_path(str(ROOT / ".ci" / "other_python.py"))["find"](minor)
    if not python:
        pytest.skip(f"no Python 3.{minor} with venv found")
    programs = install(python, wheel, tmp_path)
    escape = str(programs / "escape")
    assert run(escape, "--version", cwd=tmp_path).split() == ["escape", escape_hw.__version__]
    assert (tmp_path / "venv" / "share" / "applications" / "escape.desktop").is_file()
    poked = json.loads(
        run(escape, "dm", "poke", "razor-shwfs", "48", "0.05", "--seconds", "0", "--json", cwd=tmp_path)
    )
    assert poked["peak"] == 0.05
    words = ("calibrate", "razor-shwfs", "--method", "push-pull", "--frames", "2", "--out", "run", "--json")
    found = json.loads(run(escape, *words, cwd=tmp_path))
    assert (tmp_path / "run" / "report.html").is_file()
    assert found["simulated"] is True
    script = (
        "from escape_drivers.alpao import AlpaoMirror as M; import escape_gui; print(M(serial='B1').is_open)"
    )
    assert run(str(programs / "python"), "-c", script, cwd=tmp_path) == "False\n"
