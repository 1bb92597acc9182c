"""Frames per second of the twin, and the synthetic model, against OOPAO."""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np

from escape_benchmarks.optics.frames import oopao_frame, twin_frame
from escape_benchmarks.optics.pyramid import pyramid_rows
from escape_benchmarks.rows import frame_rate_row, time_row
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.registration import Registration
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.oopao import models as oopao_model

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

_SYSTEM = "razor-shwfs"


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    # One propagation per frame, as in OOPAO.
    still = ["twin.substeps=1", "twin.loss_probability=0"]
    fast = load_system(_SYSTEM, overrides=still)
    inside = load_system(_SYSTEM, overrides=[*still, "system.optics=oopao"])
    peer = f"OOPAO {version('OOPAO')}"
    note = "24 x 24 lenslets, 192 x 192 pupil samples; ours on 400 x 400 camera pixels"
    return [
        frame_rate_row(
            f"optics: {stage}", time_alternately(twin_frame(fast), call, seconds=3.0), peer_name, note
        )
        for stage, call, peer_name in (
            ("twin frames", oopao_frame(fast), f"{peer}: atmosphere, mirror, sensor, noise"),
            ("twin frames, OOPAO inside", twin_frame(inside), f"{peer} as system.optics"),
        )
    ] + [_matrix(fast, peer), *pyramid_rows(peer)]


def _matrix(config: SystemConfig, peer: str) -> BenchmarkRow:
    ours, theirs = make_fast_model(config, None), oopao_model.make_oopao_model(config, None)
    at = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
    a, b = ours.zonal_matrix(at), theirs.zonal_matrix(at)
    agreement = float(np.linalg.norm(a - b) / np.linalg.norm(b))
    times = time_alternately(
        lambda: ours.zonal_matrix(at), lambda: theirs.zonal_matrix(at), seconds=3.0, rounds=3
    )
    name, note = f"{peer}: mirror and sensor, push and pull", f"relative difference {agreement:.1e}"
    return time_row("optics: synthetic zonal matrix", times, name, "ms", note)
