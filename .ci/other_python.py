"""Print a second Python for the tests: the newest of 3.13, 3.12 and 3.11 that works and is not this one.

Looks along ``PATH`` and in the folders beside the installation of the Python that runs this, where several
are often kept side by side. Prints an empty line if there is none.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

#: Starts only where environments can be made; a launcher without its Python does not.
PROBE = "import sys, venv, ensurepip; print(*sys.version_info[:2])"


def candidates(minor: int) -> Iterator[Path]:
    """Files that may be Python 3 of a minor release."""
    name = f"python3.{minor}"
    for folder in os.get_exec_path():
        yield Path(folder, name)
    yield from sorted(Path(sys.base_prefix).parent.glob(f"*/bin/{name}"), reverse=True)


def works(python: Path, minor: int) -> bool:
    """Whether a file is a Python of this release in which environments can be made."""
    try:
        done = subprocess.run([python, "-c", PROBE], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.stdout.split() == ["3", str(minor)]


def find(minor: int) -> str:
    """A Python 3 of this minor release that works; empty if there is none."""
    return str(next((python for python in candidates(minor) if works(python, minor)), ""))


if __name__ == "__main__":
    others = (find(minor) for minor in (13, 12, 11) if minor != sys.version_info[1])
    print(next(filter(None, others), ""))
