"""Frames per second of the twin, and the synthetic model, against OOPAO."""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np

from escape_benchmarks.optics.frames import oopao_frame, twin_frame
from escape_benchmarks.optics.pyramid import pyramid_rows
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
    fast = load_system(_SYSTEM, overrides=["twin.substeps=1", "twin.loss_probability=0"])
    inside = load_system(
        _SYSTEM, overrides=["twin.substeps=1", "twin.loss_probability=0", "system.optics=oopao"]
    )
    peer = f"OOPAO {version('OOPAO')}"
    rows = []
    ours_s, peer_s = time_alternately(twin_frame(fast), oopao_frame(fast), seconds=3.0)
    rows.append(_rate("optics: twin frames", ours_s, peer_s, f"{peer}: atmosphere, mirror, sensor, noise"))
    ours_s, peer_s = time_alternately(twin_frame(fast), twin_frame(inside), seconds=3.0)
    rows.append(_rate("optics: twin frames, OOPAO inside", ours_s, peer_s, f"{peer} as system.optics"))
    rows.append(_matrix(fast, peer))
    return rows + pyramid_rows(peer)


def _rate(stage: str, ours_s: float, peer_s: float | None, peer: str) -> BenchmarkRow:
    note = "24 x 24 lenslets, 192 x 192 pupil samples; ours on 400 x 400 camera pixels"
    return BenchmarkRow(stage, 1 / ours_s, 1 / peer_s if peer_s else None, peer, "frame/s", "higher", note)


def _matrix(config: SystemConfig, peer: str) -> BenchmarkRow:
    ours, theirs = make_fast_model(config, None), oopao_model.make_oopao_model(config, None)
    at = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
    a, b = ours.zonal_matrix(at), theirs.zonal_matrix(at)
    agreement = float(np.linalg.norm(a - b) / np.linalg.norm(b))
    ours_s, peer_s = time_alternately(
        lambda: ours.zonal_matrix(at), lambda: theirs.zonal_matrix(at), seconds=3.0, rounds=3
    )
    return BenchmarkRow(
        "optics: synthetic zonal matrix",
        ours_s * 1e3,
        None if peer_s is None else peer_s * 1e3,
        f"{peer}: mirror and sensor, push and pull",
        "ms",
        "lower",
        f"relative difference {agreement:.1e}",
    )
