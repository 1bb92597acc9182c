"""pyRTC's pipeline, end to end: its own components and streams, on frames that are ready-made."""

from __future__ import annotations

import time
import uuid
from typing import Any

import numpy as np

from escape_hw.cli.benchmarks.latency_loop import Case, Run
from escape_hw.cli.benchmarks.peer import pyrtc

#: Seconds in which its threads get going.
_WARM_UP_S = 2.0
_STREAMS = ("wfs_raw", "wfs", "signal", "signal_2d", "wfc", "wfc_2d")


def run_peer(case: Case, seconds: float) -> Run | None:
    """Latency by pyRTC's own measure, frame published to command published; ``None``: not installed."""
    latency, streams = pyrtc("latency"), pyrtc("streams")
    if latency is None or streams is None:
        return None
    tag = f"escape_{uuid.uuid4().hex[:8]}"
    names = {key: f"{tag}_{key}" for key in _STREAMS}
    parts = _components(case, names)
    try:
        for part in parts:
            part.start()
        time.sleep(_WARM_UP_S)
        look = streams.open_stream(names["wfc"], readonly=True)
        before, began = look.count, time.perf_counter()
        report, _ = latency.measure_stream_path_latency(
            [names["wfs"], names["signal"], names["wfc"]], samples=round(seconds * case.rate_hz),
            timeout_seconds=4 * seconds + 10,
        )  # fmt: skip
        rate = (look.count - before) / (time.perf_counter() - began)
        look.close()
    except TimeoutError:
        return Run(np.array([]), 0.0, 0, ("the peer's own measurement timed out",))
    finally:
        for part in reversed(parts):
            part.close()
        streams.clear_shms(list(names.values()))
    s = report.total.statistics
    # Its report keeps percentiles only: the median and the 99th stand for all.
    return Run(np.array([s.p50_seconds, s.p99_seconds]) * 1e6, rate, 0)


def _components(case: Case, n: dict[str, str]) -> tuple[Any, ...]:
    """Corrector, slopes, loop and sensor, in the order in which they start."""
    slopes_process, loop, corrector = (
        pyrtc(name) for name in ("slopes_process", "loop", "wavefront_corrector")
    )
    if slopes_process is None or loop is None or corrector is None:
        raise RuntimeError("pyRTC is installed in part only")
    side = case.frames.shape[1]
    wfs = _replay(case)(
        {"name": "w", "width": side, "height": side, "functions": ["expose"],
         "input_streams": {"wfc": n["wfc"]}, "output_streams": {"wfs_raw": n["wfs_raw"], "wfs": n["wfs"]}}
    )  # fmt: skip
    slopes = slopes_process.SlopesProcess(
        {"type": "SHWFS", "signal_type": "slopes", "sub_ap_spacing": case.pitch, "sub_ap_offset_x": 0,
         "sub_ap_offset_y": 0, "image_noise": 0.0, "contrast": 3, "functions": ["compute_signal"],
         "input_streams": {"wfs": n["wfs"]},
         "output_streams": {"signal": n["signal"], "signal_2d": n["signal_2d"]}}
    )  # fmt: skip
    mirror = corrector.WavefrontCorrector(
        {"name": "d", "num_actuators": case.n_act, "num_modes": case.n_act, "functions": ["send_to_hardware"],
         "input_streams": {"wfc": n["wfc"]}, "output_streams": {"wfc": n["wfc"], "wfc_2d": n["wfc_2d"]}}
    )  # fmt: skip
    control = loop.Loop(
        {"functions": ["leaky_integrator"], "gain": 0.2, "leaky_gain": 0.05,
         "input_streams": {"signal": n["signal"]}, "output_streams": {"wfc": n["wfc"]}}
    )  # fmt: skip
    control.cm[:] = case.control
    control.gain = 0.2
    return mirror, slopes, control, wfs


def _replay(case: Case) -> type:
    """A sensor of the peer's kind that publishes the case's frames at its rate."""
    sensor = pyrtc("wavefront_sensor")
    if sensor is None:
        raise RuntimeError("pyRTC is installed in part only")
    base: type = sensor.WavefrontSensor

    def expose(self: Any) -> None:
        now = time.perf_counter()
        self.due = now if now - self.due > 0.1 else self.due
        if self.due > now:
            time.sleep(self.due - now)
        self.due += 1 / case.rate_hz
        self.data = case.frames[self.shown % len(case.frames)]
        self.shown += 1
        base.expose(self)  # type: ignore[attr-defined]

    return type("Replay", (base,), {"expose": expose, "due": 0.0, "shown": 0})
