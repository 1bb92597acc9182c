"""Versions of the documentation: which one is built, and a folder with all of them side by side."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

from escape_hw import __version__

DOCS = Path(__file__).parent


def describe_checkout() -> tuple[str, str]:
    """Name of the version that is checked out, and its commit with date.

    A commit with the tag ``v0.2.0`` is version 0.2.0, any other one ``development``. Without git, as in a
    source distribution, it is the package's version, and the commit is empty. Raises ``ValueError`` if the
    tag is that of another version.
    """

    def git(*words: str) -> str:
        command = ["git", "--git-dir", str(DOCS.parent / ".git"), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    try:
        commit, tags = git("log", "-1", "--format=%h, %cs"), git("tag", "--points-at", "HEAD")
    except (OSError, subprocess.CalledProcessError):
        return __version__, ""
    releases = re.findall(r"^v(\d+\.\d+\.\d+)$", tags, re.MULTILINE)
    if releases not in ([], [__version__]):
        raise ValueError(f"this commit has the tag v{releases[0]}, but the package is version {__version__}")
    return (releases or ["development"])[0], commit.strip()


def add_version(site: Path, built: Path, name: str) -> None:
    """Copy ``built`` into ``site/name``, and list the versions in ``site``, the newest release first."""
    shutil.rmtree(site / name, ignore_errors=True)
    shutil.copytree(built, site / name, ignore=shutil.ignore_patterns(".*"))
    found = (page.parent.name for page in site.glob("*/index.html"))
    names = sorted(found, key=lambda one: [int(part) for part in re.findall(r"\d+", one)], reverse=True)
    (site / "versions.js").write_text(f"var VERSIONS = {json.dumps(names)};\n", encoding="utf-8")
    links = "\n".join(f'<li><a href="{one}/index.html">{one}</a></li>' for one in names)
    newest = f'<meta http-equiv="refresh" content="0; url={names[0]}/index.html">'
    (site / "index.html").write_text(
        f"<!doctype html>\n<title>ESCAPE</title>\n{newest}\n<ul>\n{links}\n</ul>\n", encoding="utf-8"
    )
    # GitHub Pages leaves out names with an underscore without it.
    (site / ".nojekyll").touch()


if __name__ == "__main__":
    add_version(Path(sys.argv[1]), DOCS / "_build", describe_checkout()[0])
