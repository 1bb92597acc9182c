"""Callbacks for frames, slopes, commands and residuals of a bench; the server publishes them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.sensor import SensorGeometry

log = logging.getLogger(__name__)

P = ParamSpec("P")


@dataclass(frozen=True, slots=True)
class Callbacks:
    """Optional callbacks, called for every frame. Set them as ``Bench.callbacks`` before a procedure runs.

    A callback runs in the thread of the loop and must take microseconds. Its arrays are overwritten by the
    next frame, so it copies what it needs later.

    Parameters
    ----------
    frame, science
        Each frame of the wavefront sensor and of the science camera.
    slopes
        Index of the latest sensor frame, and slopes ``(n_slopes,)``, float32.
    command
        Command sent to the mirror ``(n_act,)``, float64, fraction of full stroke.
    geometry
        Sensor geometry, before slopes are computed with it.
    residual
        In closed loop: frame index, reconstructed residual ``(n_modes,)``, float32, and its rms, both in
        nm rms wavefront.
    """

    frame: Callable[[Frame], object] | None = None
    science: Callable[[Frame], object] | None = None
    slopes: Callable[[int, NDArray[np.float32]], object] | None = None
    command: Callable[[NDArray[np.float64]], object] | None = None
    residual: Callable[[int, NDArray[np.float32], float], object] | None = None
    geometry: Callable[[SensorGeometry], object] | None = None


def guarded_callback(name: str, callback: Callable[P, object] | None) -> Callable[P, None] | None:
    """Wrap a callback so that an exception is logged and disables it instead of opening the loop.

    Parameters
    ----------
    name
        Name for the log.
    callback
        The callback; ``None`` is returned unchanged.
    """
    if callback is None:
        return None
    calls = [callback]

    def call_until_failure(*args: P.args, **options: P.kwargs) -> None:
        for call in calls:
            try:
                call(*args, **options)
            except Exception:
                log.exception("the callback for %s failed and is disabled", name)
                calls.clear()

    return call_until_failure
