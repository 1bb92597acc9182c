"""Streams filled by another writer, for tests of the devices that read and write them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from escape_hw.config.system import SystemConfig
from escape_hw.io.interchange.milk.stream import MilkStream
from escape_hw.io.interchange.pyrtc.stream import ShmemStream
from escape_hw.io.interchange.stream import Stream

PERIOD_S = 0.004
SHAPE = (48, 64)


@contextmanager
def published(stream: Any, frame: Callable[[int], np.ndarray], period_s: float = PERIOD_S) -> Iterator[None]:
    """Write frames at a steady rate while the body runs."""
    stop = threading.Event()

    def work() -> None:
        due, number = time.monotonic(), 0
        while not stop.is_set():
            due += period_s
            time.sleep(max(0.0, due - time.monotonic()))
            number += 1
            stream.write(frame(number))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10)


def ramp(number: int) -> np.ndarray:
    """A frame whose every pixel tells its number; some at the top of ten bits, never beyond."""
    return (np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE) + number) % 1024


def create(kind: str, name: str, shape: tuple[int, ...], dtype: str) -> Stream:
    """A new stream."""
    return (ShmemStream if kind == "pyrtc" else MilkStream).create(name, shape, dtype)


def camera_config(config: SystemConfig, stream: str) -> SystemConfig:
    """A configuration whose wavefront-sensor camera is a stream of :data:`SHAPE`."""
    wfs = config.devices.wfs.model_copy(
        update={
            "sensor_px": SHAPE[::-1],
            "region": (8, 4, 32, 24),
            "bit_depth": 10,
            "frame_rate_hz": 1 / PERIOD_S,
            "exposure_s": 1e-3,
            "serial": "",
            "options": {"stream": stream},
        }
    )
    return config.model_copy(update={"devices": config.devices.model_copy(update={"wfs": wfs})})


def mirror_config(config: SystemConfig, stream: str, **options: float | bool) -> SystemConfig:
    """A configuration whose mirror is a stream."""
    dm = config.devices.dm.model_copy(update={"serial": "", "options": {"stream": stream, **options}})
    return config.model_copy(update={"devices": config.devices.model_copy(update={"dm": dm})})
