"""The documentation of every version is published beside that of the others."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import escape_hw

ROOT = Path(__file__).resolve().parents[2]
RELEASE = escape_hw.__version__
VERSIONS = runpy.run_path(str(ROOT / "docs" / "versions.py"))

pytestmark = pytest.mark.skipif(None in map(shutil.which, ("git", "make")), reason="needs git and make")


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=test", "-c", "user.email=test", "-c", "init.defaultBranch=main")
    command = ["git", "-C", str(folder), *who, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A clone with what publishing needs, and with a page in place of the built documentation."""
    git(tmp_path, "init", "--bare", "origin.git")
    git(tmp_path, "clone", "origin.git", "clone")
    clone = tmp_path / "clone"
    for name in (".ci/publish_docs", "docs/versions.py"):
        (clone / name).parent.mkdir()
        shutil.copy(ROOT / name, clone / name)
    git(clone, "add", "--all")
    git(clone, "commit", "--message", "first")
    (clone / ".venv" / "bin").mkdir(parents=True)
    (clone / ".venv" / "bin" / "python").symlink_to(sys.executable)
    (clone / "Makefile").write_text("docs:\n")
    (clone / "docs" / "_build").mkdir()
    return clone


def publish(checkout: Path, page: str) -> None:
    (checkout / "docs" / "_build" / "index.html").write_text(page)
    words = {"PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}
    done = subprocess.run(
        [checkout / ".ci" / "publish_docs"],
        env=os.environ | words,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_published_version_stays_beside_later_states(checkout: Path) -> None:
    git(checkout, "tag", f"v{RELEASE}")
    publish(checkout, "the release")
    git(checkout, "commit", "--allow-empty", "--message", "second")
    publish(checkout, "a later state")
    publish(checkout, "a state after that")
    origin = checkout.parent / "origin.git"
    assert git(origin, "show", f"gh-pages:{RELEASE}/index.html") == "the release"
    assert git(origin, "show", "gh-pages:development/index.html") == "a state after that"
    assert git(origin, "show", "gh-pages:versions.js") == f'var VERSIONS = ["{RELEASE}", "development"];'
    assert f"url={RELEASE}/index.html" in git(origin, "show", "gh-pages:index.html")
    assert git(origin, "rev-list", "--count", "gh-pages") == "1"


def test_a_tag_is_that_of_the_package(checkout: Path, tmp_path: Path) -> None:
    describe = runpy.run_path(str(checkout / "docs" / "versions.py"))["describe_checkout"]
    commit = git(checkout, "log", "-1", "--format=%h, %cs")
    assert describe() == ("development", commit)
    git(checkout, "tag", f"v{RELEASE}")
    assert describe() == (RELEASE, commit)
    git(checkout, "tag", "--delete", f"v{RELEASE}")
    git(checkout, "tag", "v99.0.0")
    with pytest.raises(ValueError, match=rf"tag v99\.0\.0, but the package is version {RELEASE}"):
        describe()
    shutil.rmtree(checkout / ".git")
    assert describe() == (RELEASE, "")


def test_the_newest_release_comes_first(tmp_path: Path) -> None:
    built = tmp_path / "built"
    built.mkdir()
    (built / "index.html").touch()
    for name in ("development", "0.10.0", "0.9.1", "0.2.0"):
        VERSIONS["add_version"](tmp_path / "site", built, name)
    assert (tmp_path / "site" / "versions.js").read_text() == (
        'var VERSIONS = ["0.10.0", "0.9.1", "0.2.0", "development"];\n'
    )
