"""A whole night of operation in the window: on a display (Xvfb) where it is installed, else without one."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import night
import pytest
from small_system import configuration

from escape_hw.runtime.host.doctor import missing_qt_libraries

TESTS = Path(__file__).parents[1]


@contextmanager
def display() -> Iterator[dict[str, str]]:
    """A virtual X server, or none where it is not installed; what a program needs in its environment."""
    xvfb = shutil.which("Xvfb")
    if xvfb is None or missing_qt_libraries():
        yield {"QT_QPA_PLATFORM": "offscreen"}
        return
    width, height = night.SIZES[-1]
    read, write = os.pipe()
    words = [
        xvfb,
        "-displayfd",
        str(write),
        "-screen",
        "0",
        f"{width + 64}x{height + 64}x24",
        "-nolisten",
        "tcp",
    ]
    server = subprocess.Popen(words, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb did not start"
        yield {"DISPLAY": f":{number}", "QT_QPA_PLATFORM": "xcb"}
    finally:
        server.kill()
        server.wait()


def work_through_the_night(folder: Path, environment: dict[str, str]) -> list[dict[str, object]]:
    """Run the night in a process of its own; what it said."""
    small = folder / "small.toml"
    small.write_text(configuration("calibration.checkpoint_s=1").to_toml())
    paths = [str(TESTS), str(TESTS / "gui"), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, night.__file__, "run", str(folder), str(small)],
        env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(path for path in paths if path)},
        capture_output=True, text=True, timeout=3000, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr[-4000:]}"
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


@pytest.mark.campaign
@pytest.mark.timeout(3600)
def test_a_night_of_operation(tmp_path: Path) -> None:
    began = time.monotonic()
    with display() as environment:
        said = work_through_the_night(tmp_path, environment)
    assert [one["step"] for one in said] == list(night.STEPS)
    images = list((tmp_path / "screenshots").glob("*.png"))
    assert len(images) % (len(night.SIZES) * len(night.THEMES)) == 0
    assert len(images) >= 6 * len(night.SIZES) * len(night.THEMES)
    print(f"night on {environment} in {time.monotonic() - began:.0f} s")
    print(f"{len(images)} images in {tmp_path / 'screenshots'}")
