"""pyRTC's components in this process, with separate streams."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

os.environ["PYRTC_LOG_LEVEL"] = "ERROR"
#: What to do where it is absent.
NEEDED = "needs pyRTC: pip install 'escape-hw[interchange-pyrtc]'"

pytest.importorskip("pyrtc", reason=NEEDED)
yaml = pytest.importorskip("yaml")

from pyrtc.loop import Loop  # noqa: E402
from pyrtc.slopes_process import SlopesProcess  # noqa: E402
from pyrtc.streams import clear_shms, open_stream  # noqa: E402

_STREAMS = ("wfs_raw", "wfs", "signal", "signal_2d", "wfc", "wfc_2d")


class Rig:
    """Sections of a configuration with their components and streams.

    Parameters
    ----------
    tag
        What the names of the streams begin with.
    """

    def __init__(self, tag: str) -> None:
        self.streams = {name: f"{tag}_{os.getpid()}_{name}" for name in _STREAMS}
        self.parts: list[Any] = []

    def aliases(self, reads: tuple[str, ...], writes: tuple[str, ...]) -> dict[str, Any]:
        return {
            "input_streams": {name: self.streams[name] for name in reads},
            "output_streams": {name: self.streams[name] for name in writes},
        }

    def add(self, part: Any) -> Any:
        self.parts.append(part)
        return part

    def camera(self, kind: type, **section: Any) -> Any:
        names = self.aliases(("wfc",) if kind.__name__ == "SyntheticSHWFS" else (), ("wfs_raw", "wfs"))
        return self.add(kind({"name": "w", "functions": ["expose"], **names, **section}))

    def mirror(self, kind: type, **section: Any) -> Any:
        names = self.aliases(("wfc",), ("wfc", "wfc_2d"))
        return self.add(kind({"name": "d", "functions": ["send_to_hardware"], **names, **section}))

    def slopes(self, **section: Any) -> Any:
        names = self.aliases(("wfs",), ("signal", "signal_2d"))
        return self.add(SlopesProcess({"functions": ["compute_signal"], **names, **section}))

    def loop(self, **section: Any) -> Any:
        names = self.aliases(("signal",), ("wfc",))
        return self.add(Loop({"functions": [], "watchdog_timeout": 0, **names, **section}))

    def rms(self, frames: int) -> float:
        """Rms of the slopes over some frames."""
        signal = open_stream(self.streams["signal"], readonly=True)
        try:
            count, total = int(signal.count), 0.0
            for _ in range(frames):
                found = signal.read_after_publication(count, timeout=20)
                count, total = int(found.count), total + float(np.mean(np.square(found.payload)))
            return float(np.sqrt(total / frames))
        finally:
            signal.close()


@contextmanager
def rig(tag: str) -> Iterator[Rig]:
    """A rig, closed and cleared away at the end."""
    made = Rig(tag)
    try:
        yield made
    finally:
        for part in reversed(made.parts):
            part.close()
        clear_shms(list(made.streams.values()))


def sections(settings: Path) -> dict[str, dict[str, Any]]:
    """A configuration with its files' whole paths."""
    found: dict[str, dict[str, Any]] = yaml.safe_load(settings.read_text())
    for section in found.values():
        for key in section:
            if key.endswith("_file"):
                section[key] = str(settings.parent / section[key])
    return found


def within(seconds: float, done: Any) -> bool:
    """Whether something comes true in time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if done():
            return True
        time.sleep(0.01)
    return bool(done())
