"""The wheel, installed outside the checkout: an editable install would hide missing files."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import escape_hw

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"escape_hw", "escape_gui", "escape_drivers", "escape_sim", "escape_benchmarks"}


def run(*command: str, cwd: Path, **environment: str) -> str:
    inherited = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    result = subprocess.run(
        command,
        cwd=cwd,
        env=inherited | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), cwd=ROOT)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    run(*pip, "--no-deps", "--no-index", "--target", str(folder), str(wheel), cwd=folder)
    return folder


@pytest.fixture(scope="module")
def facts(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """What a Python outside the checkout sees of the installed wheel.

    Checkouts are taken off the path again, where an editable install has put them.
    """
    script = f"""
import sys, pathlib
def is_checkout(folder):
    return any((pathlib.Path(folder) / up / "pyproject.toml").exists() for up in (".", ".."))
sys.path[:] = [folder for folder in sys.path if not is_checkout(folder)]
import importlib.metadata, importlib.resources, importlib.util, json
import escape_hw
from escape_hw.config.loader import load_system
print(json.dumps({{
    "homes": {{n: importlib.util.find_spec(n).origin for n in {sorted(PACKAGES)!r}}},
    "folders": [n for n in ("drivers", "sim_backends", "tests") if importlib.util.find_spec(n)],
    "typed": [n for n in {sorted(PACKAGES)!r} if (importlib.resources.files(n) / "py.typed").is_file()],
    "system": load_system("razor-shwfs").system.name,
    "version": [escape_hw.__version__, importlib.metadata.version("escape-hw")],
    "console": [e.value for e in importlib.metadata.entry_points(group="console_scripts", name="escape")],
}}))
"""
    outside = tmp_path_factory.mktemp("outside")
    loaded = json.loads(run(sys.executable, "-c", script, cwd=outside, PYTHONPATH=str(installed)))
    assert isinstance(loaded, dict)
    return loaded


def test_wheel_holds_the_packages_and_their_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    stem = f"escape_hw-{escape_hw.__version__}"
    assert {name.split("/")[0] for name in names} == PACKAGES | {f"{stem}.dist-info", f"{stem}.data"}
    assert "escape_hw/config/systems/razor-shwfs.toml" in names
    sources = {f"escape_sim/stand_ins/{part}" for part in ("stand_in.h", "asdk.c", "m3api.c", "aravis.c")}
    assert sources <= set(names), "stand-ins are compiled where they are needed"
    assert f"{stem}.dist-info/licenses/LICENSE" in names
    assert any(name.startswith(f"{stem}.data/data/share/escape/udev/") for name in names)
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


def test_every_module_of_the_checkout_is_in_the_wheel(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.split("/")[0] in PACKAGES}
    homes = [ROOT / "escape_hw", ROOT / "escape_gui", ROOT / "drivers/escape_drivers"]
    homes.append(ROOT / "sim_backends/escape_sim")
    on_disk = {
        str(file.relative_to(home.parent)) for home in homes for file in home.rglob("*.py") if file.is_file()
    }
    assert on_disk <= packed


def test_installed_wheel_is_what_gets_imported(facts: dict[str, object], installed: Path) -> None:
    homes = facts["homes"]
    assert isinstance(homes, dict)
    assert set(homes) == PACKAGES
    assert all(Path(home).is_relative_to(installed) for home in homes.values()), homes


def test_folders_of_the_checkout_are_not_packages(facts: dict[str, object]) -> None:
    assert facts["folders"] == []


def test_installed_wheel_is_typed_and_brings_its_systems(facts: dict[str, object]) -> None:
    assert facts["typed"] == sorted(PACKAGES)
    assert facts["system"] == "razor-shwfs"
    assert facts["version"] == [escape_hw.__version__] * 2
    assert "escape_hw.cli:main" in facts["console"]  # type: ignore[operator]
