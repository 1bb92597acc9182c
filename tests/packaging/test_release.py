"""Files of a release agree: versions, tested and oldest dependencies, desktop entry, hosted run."""

from __future__ import annotations

import configparser
import contextlib
import importlib.metadata
import os
import re
import shlex
import shutil
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
    newest = re.search(
        r"^## \[(\d+\.\d+\.\d+)\] - (unreleased|\d{4}-\d\d-\d\d)$", text("CHANGELOG.md"), re.MULTILINE
    )
    citation = dict(
        re.findall(r'^(version|date-released): "?([0-9.-]+)"?$', text("CITATION.cff"), re.MULTILINE)
    )
    assert newest is not None
    assert newest[1] == citation["version"] == escape_hw.__version__
    assert newest[2] == citation.get("date-released", "unreleased")


def test_the_package_and_its_citation_name_the_same_authors() -> None:
    cited = re.findall(r"^  - name: (.+)$", text("CITATION.cff"), re.MULTILINE)
    assert [one["name"] for one in PROJECT["authors"]] == cited


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


def test_the_entry_of_an_environment_starts_its_program_also_with_a_blank_in_its_path(tmp_path: Path) -> None:
    folder = tmp_path / "adaptive optics"
    (folder / ".venv/share/applications").mkdir(parents=True)
    shutil.copy(ROOT / "desktop/escape.desktop", folder / ".venv/share/applications")
    (command,) = re.findall(r"^\$ (sed .*) >", text("docs/tutorial/operator.md"), re.MULTILINE)
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, capture_output=True, text=True, check=True, timeout=60
    )
    (line,) = re.findall("^Exec=(.*)$", done.stdout, re.MULTILINE)
    assert shlex.split(line) == [str(folder / ".venv/bin/escape"), "gui"]


def test_the_hosted_run_is_the_local_one() -> None:
    head, *jobs = re.split(
        r"^  (\w+):\n", text(".github/workflows/ci.yml").split("\njobs:\n")[1], flags=re.MULTILINE
    )
    steps = {
        name: re.findall(r"^ +- run: (.*)$", job, re.MULTILINE)
        for name, job in zip(jobs[::2], jobs[1::2], strict=True)
    }
    install = "sudo python3 tests/system_packages.py --install"
    assert not head
    assert steps == {
        "run": [install, ".ci/run"],
        "everything": [install, "make test-all"],
        "constraints": [install, "make test CONSTRAINTS=constraints.txt"],
        "container": ["docker build --file Containerfile --tag escape .", "docker run --rm escape --version"],
    }


def test_every_python_that_the_package_names_is_tested() -> None:
    named = re.findall(r"Python :: 3\.(\d+)$", "\n".join(PROJECT["classifiers"]), re.MULTILINE)
    hosted = re.findall(r"^ +3\.(\d+)$", text(".github/workflows/ci.yml"), re.MULTILINE)
    (installed,) = re.findall(
        r'parametrize\("minor", \[([\d, ]+)\]\)', text("tests/packaging/test_install.py")
    )
    assert named == hosted == installed.split(", ")
    assert PROJECT["requires-python"] == f">=3.{named[0]}"


def test_an_environment_is_made_with_the_tested_versions() -> None:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    words = ["make", "--dry-run", "--always-make", f"PYTHON={sys.executable}", "test"]
    # The settings of a make that runs this test are not for this one.
    own = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = [
        subprocess.run(
            [*words, *more], cwd=ROOT, env=own, capture_output=True, text=True, check=True, timeout=60
        )
        for more in ([], ["CONSTRAINTS=constraints.txt"])
    ]
    newest, tested = (one.stdout for one in done)
    assert "-m venv .venv\n" in newest
    assert "--constraint" not in newest
    assert "-m venv .venv-tested\n" in tested
    assert re.search(
        r"^\.venv-tested/bin/python -m pip .* --constraint constraints\.txt --editable", tested, re.MULTILINE
    )


@pytest.mark.parametrize("works", [True, False])
def test_continuous_integration_says_that_the_oldest_versions_are_skipped(
    works: bool, tmp_path: Path
) -> None:
    """With programs that only print what they are called with."""
    for name, does in {
        "bin/make": 'echo "make $*"',
        "bin/id": "echo 1000",
        "bin/python3": "exit 0",
        "bin/python3.11": f"exit {0 if works else 1}",
        ".venv/bin/python": "exit 0",
    }.items():
        program = tmp_path / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text(f"#!/bin/sh\n{does}\n", encoding="utf-8")
        program.chmod(0o755)
    (tmp_path / ".ci").mkdir()
    run = shutil.copy(ROOT / ".ci" / "run", tmp_path / ".ci" / "run")
    environment = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "HOME": str(tmp_path)}
    done = subprocess.run([run], env=environment, capture_output=True, text=True, check=True, timeout=60)
    assert ("make floor" in done.stdout) is works
    assert ("oldest versions skipped: no python3.11 with venv found" in done.stdout) is not works


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
