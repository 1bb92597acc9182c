"""Modules that an import loads, and those that it must not."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import escape_hw

HEAVY = ["OOPAO", "PySide6", "astropy", "matplotlib", "numba", "numpy", "pyqtgraph", "scipy", "skimage"]
VENDOR = ["serial", "usb", "ximea", "asdk", "Lib64", "pipython", "rotpy", "gi"]


def loaded_by(statement: str) -> set[str]:
    code = f"{statement}\nimport sys, json; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    return {name.partition(".")[0] for name in json.loads(run.stdout)}


def test_importing_the_package_is_cheap() -> None:
    loaded = loaded_by("import escape_hw")
    assert "escape_hw" in loaded
    assert not loaded & {*HEAVY, *VENDOR, "pydantic", "rich", "typer"}


@pytest.mark.parametrize(
    "statement",
    [
        "import escape_hw.runtime.session.system, escape_hw.bench, escape_hw.config.registry",
        "import escape_drivers",
        "import escape_gui",
    ],
)
def test_no_vendor_library_and_no_qt_before_something_opens(statement: str) -> None:
    assert not loaded_by(statement) & {*VENDOR, "PySide6", "pyqtgraph", "matplotlib", "OOPAO"}


def test_public_names_are_listed_and_load() -> None:
    assert set(escape_hw.__all__) <= set(dir(escape_hw))
    assert set(escape_hw._PUBLIC_MODULES) == set(escape_hw.__all__) - {"__version__"}
    for name in escape_hw.__all__:
        assert getattr(escape_hw, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'opne_system'"):
        escape_hw.opne_system  # noqa: B018


@pytest.mark.parametrize("contract", ["core", "calibration"])
def test_the_decision_on_the_layout_lists_the_layers_that_are_checked(contract: str) -> None:
    root = Path(__file__).parents[2]
    contracts = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = [one["layers"] for one in contracts if one["id"] == contract]
    page = " ".join((root / "docs/decisions/0001-layout.md").read_text().split())
    assert ", ".join(f"`{layer}`" for layer in layers) in page
