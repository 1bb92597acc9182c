"""The telemetry buffer of a loop, and its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from escape_hw.api.camera import Frame
from escape_hw.errors import ProductError
from escape_hw.io.fits.telemetry import LoopTelemetry, load_telemetry, save_telemetry
from escape_hw.runtime.procedures.loop_telemetry import LoopTelemetryRecorder


def play(recorder: LoopTelemetryRecorder, index: int, answer: float | None) -> None:
    """A frame, its slopes, and the command that answers it."""
    callbacks = recorder.callbacks
    assert callbacks.frame is not None
    assert callbacks.slopes is not None
    assert callbacks.command is not None
    callbacks.frame(Frame(np.zeros((2, 2), np.uint16), index, index * 2_000_000, index * 2_000_000 + 5))
    buffer = np.full(4, index, np.float32)
    callbacks.slopes(index, buffer)
    buffer[:] = -1  # what a callback gets is overwritten
    if answer is not None:
        callbacks.command(np.full(3, answer))


def test_the_newest_frames_are_kept_in_order() -> None:
    recorder = LoopTelemetryRecorder(5, 4, 3)
    for index in (1, 2, 4, 5, 6, 7, 9):
        play(recorder, index, index / 10)
    found = recorder.to_telemetry()
    assert found.index.tolist() == [4, 5, 6, 7, 9]
    np.testing.assert_array_equal(found.slopes[:, 0], found.index)
    np.testing.assert_allclose(found.commands[:, 2], found.index / 10)
    np.testing.assert_allclose(found.exposed_s, (found.index - 4) * 0.002)
    assert found.rate_hz == pytest.approx(500)


def test_only_the_first_command_answers_a_frame() -> None:
    recorder = LoopTelemetryRecorder(5, 4, 3)
    play(recorder, 1, 0.1)
    play(recorder, 2, None)
    play(recorder, 3, 0.3)
    assert recorder.callbacks.command is not None
    recorder.callbacks.command(np.zeros(3))  # flattened at the end
    assert recorder.to_telemetry().commands[:, 0].tolist() == [0.1, 0.1, 0.3]


def test_a_new_start_of_the_camera_begins_anew() -> None:
    recorder = LoopTelemetryRecorder(5, 4, 3)
    for index in (7, 8, 1, 2):
        play(recorder, index, 0.0)
    assert recorder.to_telemetry().index.tolist() == [1, 2]
    assert LoopTelemetryRecorder(5, 4, 3).to_telemetry().rate_hz == 0


def test_slopes_of_another_geometry_are_left_out() -> None:
    recorder = LoopTelemetryRecorder(5, 4, 3)
    assert recorder.callbacks.slopes is not None
    recorder.callbacks.slopes(1, np.zeros(6, np.float32))
    assert recorder.to_telemetry().index.size == 0


def test_telemetry_on_disk(tmp_path: Path) -> None:
    recorder = LoopTelemetryRecorder(5, 4, 3)
    for index in (1, 2, 4):
        play(recorder, index, index / 10)
    record = recorder.to_telemetry()
    back = load_telemetry(save_telemetry(tmp_path / "t.fits", record, "a", True))
    for name in ("index", "exposed_s", "slopes", "commands"):
        np.testing.assert_array_equal(getattr(back.result, name), getattr(record, name))
    assert back.header["SIMULATE"] is True
    content = bytearray((tmp_path / "t.fits").read_bytes())
    content[-2000] ^= 1
    (tmp_path / "t.fits").write_bytes(content)
    with pytest.raises(ProductError, match="damaged"):
        load_telemetry(tmp_path / "t.fits")
    with pytest.raises(ValueError, match="equally long"):
        LoopTelemetry(record.index[:2], record.exposed_s, record.slopes, record.commands)
