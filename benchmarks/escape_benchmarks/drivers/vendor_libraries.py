"""Stage ``drivers``: what a driver costs beside calling the vendor's C functions directly.

The stand-ins do next to nothing per call, so the figures are the driver's own. The peer makes the same call
through ctypes with arguments prepared once: the least that Python can do. What a C program pays stands in
the note.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from escape_benchmarks.rows import time_row
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.device import Device
from escape_hw.bench import build_device
from escape_hw.config.loader import load_system
from escape_sim.stand_ins import StandIn, StandInUnavailable

_IMAGE_BYTES = 288
_BP_AT = 8


def run() -> list[BenchmarkRow]:
    """All rows of the stage; rows without figures where there is no compiler."""
    try:
        return [*_mirror(StandIn("asdk").clear(record=False)), *_camera(StandIn("m3api"))]
    except StandInUnavailable as reason:
        return [BenchmarkRow("drivers", 0.0, None, "C library", "us", "lower", str(reason))]


def _device(key: str, library: StandIn) -> Any:
    chosen = f'devices.{key}.options.library="{library.path}"'
    config = load_system("razor-shwfs", mode="hardware", overrides=[chosen])
    return build_device(key, config, Device)  # type: ignore[type-abstract]


def _mirror(asdk: StandIn) -> list[BenchmarkRow]:
    with _device("dm", asdk) as dm:
        values = np.linspace(-0.1, 0.1, 97)
        values.setflags(write=False)
        handle, pointer = dm.handle, ctypes.c_void_p(values.ctypes.data)
        send = ctypes.CDLL(str(asdk.path)).asdkSend
        send.argtypes, send.restype = [ctypes.c_void_p, ctypes.c_void_p], ctypes.c_int
        time_c = asdk.library.escape_stand_in_time
        time_c.argtypes, time_c.restype = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long], ctypes.c_double
        in_c = time_c(handle, pointer, 100_000) * 1e-3
        # The driver's own part, behind the guard, is what is measured.
        transfer = dm._send  # noqa: SLF001
        calls = {"transfer": lambda: transfer(values), "send, with the guard": lambda: dm.send(values)}
        return [
            _row(
                f"drivers: ALPAO {what}",
                time_alternately(call, lambda: send(handle, pointer), seconds=0.3),
                "asdkSend by ctypes",
                f"in C {in_c:.2f} us",
            )
            for what, call in calls.items()
        ]


def _camera(m3api: StandIn) -> list[BenchmarkRow]:
    rows = []
    for dim, what in ((1, "no pixel saturated"), (0, "some saturated")):
        m3api.clear(record=False).script(f"set real_time 0; set attenuation {dim}")
        with _device("wfs", m3api) as camera:
            rows.append(_frame(m3api, camera, what))
    return rows


def _frame(m3api: StandIn, camera: Any, what: str) -> BenchmarkRow:
    shape = camera.next_frame(1.0).data.shape
    buffer = ctypes.create_string_buffer(_IMAGE_BYTES)
    ctypes.c_uint32.from_buffer(buffer).value = _IMAGE_BYTES
    get = ctypes.CDLL(str(m3api.path)).xiGetImage
    get.argtypes, get.restype = [ctypes.c_void_p, ctypes.c_uint32, ctypes.c_void_p], ctypes.c_int
    handle, address = camera.handle, ctypes.c_void_p(ctypes.addressof(buffer))
    pixels = ctypes.c_void_p.from_buffer(buffer, _BP_AT)
    kind = ctypes.c_uint16 * (shape[0] * shape[1])

    def directly() -> None:
        # What any user must do: get the image and copy it before the ring turns.
        if get(handle, 50, address) != 0:
            raise RuntimeError("the stand-in gave no image")
        np.frombuffer(kind.from_address(pixels.value or 0), np.uint16).copy()

    # Both read the same camera; to either, the other's frames are lost ones.
    times = time_alternately(lambda: camera.next_frame(1.0), directly, seconds=0.4)
    time_c = m3api.library.escape_stand_in_time
    time_c.argtypes, time_c.restype = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long], ctypes.c_double
    note = f"in C, without the copy, {time_c(handle, address, 20_000) * 1e-3:.2f} us"
    stage = f"drivers: XIMEA frame {shape[1]} x {shape[0]}, {what}"
    return _row(stage, times, "xiGetImage by ctypes, copied", note)


def _row(stage: str, times: tuple[float, float | None], peer: str, note: str) -> BenchmarkRow:
    ours_s, peer_s = times
    assert peer_s is not None
    return time_row(stage, times, peer, "us", f"{(ours_s - peer_s) * 1e6:+.2f} us; {note}")
