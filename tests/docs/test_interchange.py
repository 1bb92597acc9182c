"""The page on other software begins with code that works on its streams."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from pages import ROOT, blocks_of

from escape_hw.io.interchange.milk.stream import MilkStream


def test_the_first_code_works_on_streams_of_milk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    frames, commands = MilkStream.create("wfs", (48, 64), "uint16"), MilkStream.create("dm", (97,), "float32")
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.005):
            frames.write(np.full((48, 64), 7, np.uint16))

    writer = threading.Thread(target=publish, daemon=True)
    writer.start()
    found: dict[str, object] = {}
    try:
        exec(blocks_of(ROOT / "docs" / "interchange.md")[0].text, found)
    finally:
        stop.set()
        writer.join(10)
    assert found["frame"].data.shape == (48, 64)  # type: ignore[attr-defined]
    assert found["shape"][48] == 0.05  # type: ignore[index]
    assert commands.count > 1
    assert not commands.latest().data.any()
    for stream in (frames, commands):
        stream.close()
