"""Files of a release agree: versions, tested and oldest dependencies, desktop entry, hosted run."""

from __future__ import annotations

import configparser
import contextlib
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import escape_hw

ROOT = Path(__file__).resolve().parents[2]
#: Extras of what optional tests need.
ALL = ("all", "interchange", "interchange-pyrtc", "dask", "postgresql")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def text(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


def pins(lines: str) -> dict[str, str]:
    found = re.findall(r"^([A-Za-z0-9_.-]+)==(\S+)$", lines, re.MULTILINE)
    return {canonicalize_name(name): version for name, version in found}


def requirements(*extras: str) -> list[Requirement]:
    """Requirements of the package and of some of its extras, without those that name the package itself."""
    groups = [PROJECT["dependencies"], *(PROJECT["optional-dependencies"][name] for name in extras)]
    found = [Requirement(one) for group in groups for one in group]
    return [one for one in found if one.name != PROJECT["name"]]


def test_every_place_has_the_same_version() -> None:
    newest = re.search(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", text("CHANGELOG.md"), re.MULTILINE)
    citation = dict(
        re.findall(r'^(version|date-released): "?([0-9.-]+)"?$', text("CITATION.cff"), re.MULTILINE)
    )
    assert newest is not None
    assert newest[1] == citation["version"] == escape_hw.__version__
    assert newest[2] == citation["date-released"]


def test_tested_versions_satisfy_every_requirement() -> None:
    tested = pins(text("constraints.txt"))
    for requirement in requirements("gui", "sweep", "test", "docs", "dev", *ALL):
        assert tested[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_what_a_tested_version_needs_is_tested_too() -> None:
    """As far as the tested versions are installed here; others may need other packages."""
    tested = pins(text("constraints.txt"))
    waiting, seen = requirements("gui", "sweep", "test", "docs", "dev", *ALL), set()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        assert name in tested
        for extra in {"", *requirement.extras} - {extra for one, extra in seen if one == name}:
            seen.add((name, extra))
            waiting += requirements_of(name, tested[name], extra)
    assert len(seen) > len(PROJECT["dependencies"])


def requirements_of(name: str, version: str, extra: str) -> list[Requirement]:
    """What this version of a package needs with Python 3.11; nothing if it is not installed here."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        if importlib.metadata.version(name) == version:
            needed = map(Requirement, importlib.metadata.requires(name) or ())
            case = {"python_version": "3.11", "extra": extra}
            return [one for one in needed if one.marker is None or one.marker.evaluate(case)]
    return []


def test_the_oldest_versions_are_those_of_the_project() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / ".ci" / "floor.py")],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    oldest = pins(done.stdout)
    for requirement in requirements(*PROJECT["optional-dependencies"]):
        version = oldest[canonicalize_name(requirement.name)].removesuffix(".*")
        assert version in requirement.specifier
        assert f">={version}" in str(requirement.specifier)
        assert not re.search(r"[<]|==|~=", str(requirement.specifier)), "no upper limits"


def test_the_desktop_entry_starts_the_window() -> None:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(text("desktop/escape.desktop"))
    entry = parser["Desktop Entry"]
    program, command = entry["Exec"].split()
    assert program in PROJECT["scripts"]
    assert (command, entry["Type"], entry["Terminal"]) == ("gui", "Application", "false")
    assert (ROOT / "escape_gui" / f"{entry['Icon']}.svg").is_file()


def test_the_hosted_run_is_the_local_one() -> None:
    steps = re.findall(r"^ +- run: (.*)$", text(".github/workflows/ci.yml"), re.MULTILINE)
    assert steps == ["sudo python3 tests/system_packages.py --install", ".ci/run"]


#: Marks of tests that continuous integration does not run, and why; CONTRIBUTING.md says when they are run.
NOT_IN_CI = {
    "campaign": "the campaigns take longer than the hour that continuous integration has",
    "screenshots": "they test nothing: they make the pictures of the documentation",
    "hardware": "they need a device",
}


def test_continuous_integration_runs_every_test_or_says_why_not() -> None:
    options = tomllib.loads(text("pyproject.toml"))["tool"]["pytest"]["ini_options"]
    marks = {line.partition(":")[0] for line in options["markers"]}
    left_out = set(re.findall(r"not (\w+)", options["addopts"]))
    run = set(re.findall(r'^"\$\{bare\[@\]\}" make test ARGS="-m (\w+)"$', text(".ci/run"), re.MULTILINE))
    assert left_out - run == set(NOT_IN_CI), "a mark that is neither run nor excluded with a reason"
    assert marks >= left_out >= run
    for mark in NOT_IN_CI:
        assert f"`{mark}`" in text("CONTRIBUTING.md")


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_of_the_files_beside_the_readme(name: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text(name)):
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_the_container_installs_what_is_there() -> None:
    lines = text("Containerfile")
    assert "constraints.txt" in lines
    assert set(re.findall(r"'/source\[([a-z,]+)\]'", lines)[0].split(",")) <= set(
        PROJECT["optional-dependencies"]
    )
