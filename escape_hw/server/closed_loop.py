"""The loop that stays closed until somebody opens it, its parameters changed on the way."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.loop_run import RunningLoop
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor
from escape_hw.pipeline.integrator import LeakyIntegrator

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.server.board import LoopSettings

#: Frames between two looks at the parameters.
_STRETCH = 25


def keep_closed(
    bench: Bench, product: MatrixProduct, settings: LoopSettings, find: Callable[[str], MatrixProduct]
) -> Procedure[None]:
    """Keep the loop closed; ends by itself only when it diverges. The mirror ends flat."""
    prepare_sensor(bench)
    known = replace(settings)
    control = _control(bench, product, known)
    loop = RunningLoop(bench, product.matrix.m2c, extractor(bench, product.grid), control)
    bench.dm.flatten()
    try:
        while not loop.record.diverged:
            report = Reporter("closed loop", _STRETCH)
            yield from loop.run(_STRETCH, report=report)
            loop.record.latency, loop.record.residual = array("q"), array("f")
            if settings.version != known.version:
                now = replace(settings)
                if now.matrix != known.matrix:
                    product = find(now.matrix)
                changed = _control(bench, product, now)
                changed.applied(loop.control.state)  # type: ignore[attr-defined]
                loop.control, known = changed, now
    finally:
        bench.dm.flatten()


def _control(bench: Bench, product: MatrixProduct, settings: LoopSettings) -> LeakyIntegrator:
    return integrator_for(
        bench, product.matrix, product.grid,
        gain=settings.gain, leak=settings.leak, dropped_modes=settings.dropped_modes,
    )  # fmt: skip
