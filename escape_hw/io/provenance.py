"""Where a product comes from: software, configuration, devices, parents, time."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import escape_hw.errors
from escape_hw.version import __version__


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a product.

    Parameters
    ----------
    config_text
        The whole configuration as TOML, overrides included.
    basis
        Kind of modal basis (``kl``, ``zonal``, ``file``), empty when unknown.
    seed
        Seed of the random streams, ``None`` when none was used.
    serials
        Serial number of every device by its name in the configuration.
    parents
        SHA-256 of every product this one was made from, by file name.
    started
        When the measurement began (any time zone; written as UTC).
    """

    config_text: str = ""
    basis: str = ""
    seed: int | None = None
    serials: Mapping[str, str] = field(default_factory=dict)
    parents: Mapping[str, str] = field(default_factory=dict)
    started: datetime | None = None


def format_utc(moment: datetime | None = None) -> str:
    """A time as FITS writes it, in UTC to the millisecond; now when none is given."""
    moment = datetime.now(UTC) if moment is None else moment.astimezone(UTC)
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds")


def format_local_time(at_utc: str) -> str:
    """Local time of day of a UTC time as FITS writes it; any other text is returned unchanged."""
    try:
        moment = datetime.strptime(at_utc.partition(".")[0], "%Y-%m-%dT%H:%M:%S")
    except ValueError:
        return at_utc
    return f"{moment.replace(tzinfo=UTC).astimezone():%H:%M:%S}"


def file_sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def get_software_version() -> str:
    """Version of this package."""
    return __version__


@cache
def get_git_state() -> str:
    """Commit of the checkout this code runs from, with ``+changes`` when it was edited.

    ``unknown`` when the code does not run from a git checkout; never fails.
    """
    package_folder = Path(escape_hw.errors.__file__).resolve().parent
    commit = _run_git(package_folder, "rev-parse", "--short=12", "HEAD")
    # A site-packages folder may be inside another repository: check that git tracks this package.
    is_tracked = _run_git(package_folder, "ls-files", "--error-unmatch", "errors.py")
    if not commit or not is_tracked:
        return "unknown"
    changes = _run_git(package_folder, "status", "--porcelain", "--untracked-files=no")
    return commit + ("+changes" if changes else "")


def _run_git(folder: Path, *arguments: str) -> str:
    try:
        answer = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=5,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
