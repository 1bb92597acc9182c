"""Programs and libraries of the system that optional tests need: which are missing, and how to get them.

``python tests/system_packages.py [--install | --window]``. ``--install`` installs with apt if it runs as root
and apt works; otherwise it says what to type. The tests that need what is missing are skipped, so its exit
code is 0. ``--window`` looks only for the libraries that Qt loads, without which pytest cannot start, and
exits with 1 where they are missing.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from ctypes.util import find_library
from importlib.util import find_spec
from pathlib import Path

SHARED = Path(os.environ.get("ESCAPE_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))


def can_load(*names: str) -> bool:
    """Whether all these libraries can be loaded."""
    try:
        for name in names:
            ctypes.CDLL(name)
    except OSError:
        return False
    return True


def has_postgres() -> bool:
    """Whether a PostgreSQL server can be started, also one outside ``PATH``."""
    return bool(shutil.which("initdb") or list(Path("/usr/lib/postgresql").glob("*/bin/initdb")))


def find_browser() -> str | None:
    """Chromium, or Chrome, which understands the same options."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


QT = (
    "libglib-2.0.so.0", "libEGL.so.1", "libGL.so.1", "libxkbcommon.so.0", "libfontconfig.so.1",
    "libdbus-1.so.3",
)  # fmt: skip
QT_PACKAGES = ("libglib2.0-0", "libegl1", "libgl1", "libxkbcommon0", "libfontconfig1", "libdbus-1-3")
X11 = (
    "libxcb-cursor.so.0", "libxcb-icccm.so.4", "libxcb-image.so.0", "libxcb-keysyms.so.1",
    "libxcb-render-util.so.0", "libxcb-shape.so.0", "libxkbcommon-x11.so.0",
)  # fmt: skip
X11_PACKAGES = (
    "xvfb", "libxcb-cursor0", "libxcb-icccm4", "libxcb-image0", "libxcb-keysyms1", "libxcb-render-util0",
    "libxcb-shape0", "libxkbcommon-x11-0",
)  # fmt: skip
#: What the tests need, how to look for it, and the packages of Debian that bring it.
NEEDED: tuple[tuple[str, Callable[[], object], tuple[str, ...]], ...] = (
    (
        "a C compiler, for the stand-ins of vendors' libraries",
        lambda: shutil.which("cc"),
        ("gcc", "libc6-dev"),
    ),
    ("PostgreSQL, for sweeps of several computers", has_postgres, ("postgresql",)),
    ("Aravis with its fake camera", lambda: can_load("libaravis-0.8.so.0"), ("libaravis-0.8-0",)),
    ("libraries that Qt loads, for the window", lambda: can_load(*QT), QT_PACKAGES),
    (
        "Xvfb and the libraries of Qt for X11, for a night of operation on a display",
        lambda: shutil.which("Xvfb") and can_load(*X11),
        X11_PACKAGES,
    ),
    ("Chromium, for reports in a browser", find_browser, ("chromium",)),
    ("setpriv, to run commands as another user", lambda: shutil.which("setpriv"), ("util-linux",)),
)
#: What tests use where it is and nothing here installs, how to look for it, and why.
NOT_INSTALLED: tuple[tuple[str, Callable[[], object], str], ...] = (
    (
        "milk's ImageStreamIO",
        lambda: os.environ.get("ESCAPE_IMAGESTREAMIO_LIBRARY") or find_library("ImageStreamIO"),
        "Debian and PyPI have no package of it (docs/interchange.md)",
    ),
    (
        "PI's client PIPython",
        lambda: find_spec("pipython"),
        "its licence allows use with PI's products only: pip install '.[pi-client]'",
    ),
    (
        "XIMEA's wrapper ximea-py",
        lambda: find_spec("ximea"),
        "it comes without a licence: pip install '.[ximea-client]'",
    ),
    (
        "matrices of real instruments",
        lambda: SHARED.is_dir(),
        "they are not part of this repository: ESCAPE_SHARED_DATA names their folder (CONTRIBUTING.md)",
    ),
)


def install(packages: list[str]) -> bool:
    """Install with apt; false if that is not possible."""
    apt = shutil.which("apt-get")
    if os.geteuid() != 0 or apt is None:
        return False
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}

    def succeeds(*words: str) -> bool:
        try:
            done = subprocess.run([apt, "--quiet", *words], env=environment, timeout=600, check=False)
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    if not succeeds("update"):
        return False
    options = ("install", "--yes", "--no-install-recommends")
    # One package that this system does not have keeps apt from all others.
    return succeeds(*options, *packages) or any([succeeds(*options, one) for one in packages])


def check_window() -> None:
    """Stop if Qt cannot be loaded."""
    if not can_load(*QT):
        sys.exit(
            f"the tests need the libraries that Qt loads; as root: apt-get install {' '.join(QT_PACKAGES)}"
        )


def main() -> None:
    """Say what is missing, and install it if asked to."""
    if "--window" in sys.argv[1:]:
        check_window()
        return
    for what, is_there, reason in NOT_INSTALLED:
        if not is_there():
            print(f"missing, and not installed here: {what}; {reason}")
    missing = [(what, packages) for what, is_there, packages in NEEDED if not is_there()]
    names = [name for _, packages in missing for name in packages]
    for what, packages in missing:
        print(f"missing: {what} ({' '.join(packages)})")
    if names and "--install" in sys.argv[1:] and install(names):
        missing = [(what, packages) for what, is_there, packages in NEEDED if not is_there()]
        names = [name for _, packages in missing for name in packages]
    if names:
        print(f"tests that need these are skipped; as root: apt-get install {' '.join(names)}")
    else:
        print("all programs and libraries of the system that tests need are there")


if __name__ == "__main__":
    main()
