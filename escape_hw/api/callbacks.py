"""Taps: where a server looks at frames, slopes and commands that pass."""

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
    """Who is told what passes through a bench; set them as ``Bench.taps`` before anything runs.

    A tap is called in the thread of the loop and must take microseconds. What it gets is overwritten by
    the next frame: it copies what it keeps. Where none is set, nothing is called.

    Parameters
    ----------
    frame, science
        Every frame of the sensor's and of the science camera.
    slopes
        Index of the sensor's newest frame, and slopes ``(n_slopes,)``, float32.
    command
        What the mirror got ``(n_act,)``, float64, fraction of full stroke.
    geometry
        The sensor's geometry, whenever slopes are about to be made on it.
    residual
        Of a closed loop: index of the frame, reconstructed residual ``(n_modes,)``, float32, and its rms,
        both nm rms wavefront.
    """

    frame: Callable[[Frame], object] | None = None
    science: Callable[[Frame], object] | None = None
    slopes: Callable[[int, NDArray[np.float32]], object] | None = None
    command: Callable[[NDArray[np.float64]], object] | None = None
    residual: Callable[[int, NDArray[np.float32], float], object] | None = None
    geometry: Callable[[SensorGeometry], object] | None = None


def guarded_callback(name: str, callback: Callable[P, object] | None) -> Callable[P, None] | None:
    """A tap that is dropped when it raises, instead of opening a loop.

    Parameters
    ----------
    name
        What it is called in the log.
    tap
        ``None`` stays ``None``.
    """
    if callback is None:
        return None
    calls = [callback]

    def call_until_failure(*args: P.args, **options: P.kwargs) -> None:
        for call in calls:
            try:
                call(*args, **options)
            except Exception:
                log.exception("the tap of %s failed and is dropped", name)
                calls.clear()

    return call_until_failure
