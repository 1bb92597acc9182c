"""Installation of udev rules and of limits for real-time processes and USB memory."""

from __future__ import annotations

import difflib
import os
import shutil
import site
import subprocess
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import escape_hw.errors
from escape_hw.errors import ConfigError, StorageError
from escape_hw.io.storage import make_folder, write_atomic

#: Files of the package, and the folders they are installed in.
TARGETS = {
    "70-escape.rules": "etc/udev/rules.d",
    "90-escape-realtime.conf": "etc/security/limits.d",
    "escape-usbfs.conf": "etc/modprobe.d",
}
#: Groups that the files name.
GROUPS = ("plugdev", "dialout", "realtime")
Condition = Literal["missing", "different", "installed"]


@dataclass(frozen=True, slots=True)
class Change:
    """One file to install: its copy in the package, its target with its condition, and their difference.

    ``difference`` is a unified difference from the present target to the new one; empty when they agree.
    """

    source: Path
    target: Path
    condition: Condition
    difference: str


def find_packaged_files() -> Path:
    """Folder of the files: in the checkout, or in the environment's ``share``.

    Raises
    ------
    ConfigError
        They were not installed with the package.
    """
    inside = Path("share") / "escape" / "udev"
    places = [
        Path(escape_hw.errors.__file__).parents[1] / "udev",
        Path(sysconfig.get_path("data")) / inside,
        Path(site.getuserbase()) / inside,
    ]
    for place in places:
        if all((place / name).is_file() for name in TARGETS):
            return place
    raise ConfigError(
        f"the udev files are in none of {', '.join(map(str, places))}; install the package again"
    )


def plan_changes(root: Path = Path("/")) -> list[Change]:
    """The changes that the installation would make below ``root``; changes nothing.

    Raises
    ------
    ConfigError
        The files were not installed with the package.
    StorageError
        A present file cannot be read.
    """
    folder = find_packaged_files()
    return [_change(folder / name, root / place / name) for name, place in TARGETS.items()]


def _change(source: Path, target: Path) -> Change:
    new = source.read_text(encoding="utf-8")
    try:
        old = target.read_text(encoding="utf-8") if target.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{target}: cannot be read ({error})") from error
    if new == old:
        return Change(source, target, "installed", "")
    lines = difflib.unified_diff(
        old.splitlines(), new.splitlines(), str(target) if old else "nothing", str(target), lineterm=""
    )
    return Change(source, target, "different" if old else "missing", "\n".join(lines))


def is_writable(changes: list[Change]) -> bool:
    """Whether this user may write the targets."""
    for change in changes:
        folder = change.target.parent
        while not folder.exists():
            folder = folder.parent
        if not os.access(folder, os.W_OK):
            return False
    return True


def apply_changes(changes: list[Change]) -> list[Path]:
    """Install the files that are missing or different; returns the files written.

    Raises
    ------
    StorageError
        A file cannot be written.
    """
    written = []
    for change in changes:
        if change.condition != "installed":
            make_folder(change.target.parent)
            write_atomic(change.target, change.source.read_bytes())
            # Readable by every user.
            change.target.chmod(0o644)
            written.append(change.target)
    return written


def reload_rules() -> list[str]:
    """Make the running udev read the rules again; returns its errors."""
    udevadm = shutil.which("udevadm")
    if udevadm is None:
        return ["udevadm is not installed; the rules take effect after a restart"]
    failures = []
    for words in (["control", "--reload-rules"], ["trigger", "--subsystem-match=usb"]):
        try:
            done = subprocess.run([udevadm, *words], capture_output=True, text=True, timeout=30, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            failures.append(f"udevadm {words[0]}: {error}")
            continue
        if done.returncode:
            failures.append(f"udevadm {words[0]}: {done.stderr.strip() or done.returncode}")
    return failures


def remaining_commands(user: str) -> list[str]:
    """Commands for the user's groups, which the installation does not run."""
    groups = ",".join(GROUPS)
    return [
        "sudo groupadd --system --force realtime",
        f"sudo usermod --append --groups {groups} {user}   # then log out and in again",
    ]
