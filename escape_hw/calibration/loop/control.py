"""What is asked of a loop that runs: another gain, leak, matrix, or to open; from any thread."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.calibration.loop.performance import build_integrator
from escape_hw.errors import ConfigError
from escape_hw.pipeline.control.integrator import LeakyIntegrator


@dataclass(frozen=True, slots=True, eq=False)
class LoopSettings:
    """Settings of a loop.

    Parameters
    ----------
    closing
        The calibration whose matrix closes it.
    """

    calibration: CalibrationResult
    gain: float
    leak: float
    dropped_modes: int


@dataclass(frozen=True, slots=True, eq=False)
class LoopChange:
    """Settings with what follows from them, ready to be put in place.

    Parameters
    ----------
    control, slopes_of
        Controller by the settings, and slopes about the matrix's own references.
    outside
        Combinations of modes that the controller does not drive ``(n_modes, n)``, orthonormal.
    """

    settings: LoopSettings
    control: LeakyIntegrator
    slopes_of: SlopeFunction
    undriven: NDArray[np.float32]


class LoopControl:
    """Takes orders for a loop and hands them over between two frames.

    All that takes time, such as to invert a matrix, happens in the thread that asks.

    Parameters
    ----------
    bench, closing
        The bench, and the calibration whose matrix closes the loop.
    gain, leak, dropped_modes
        As configured by default.

    Raises
    ------
    ConfigError, IncompatibleProduct, CalibrationError
        As for :func:`~escape_hw.calibration.loop.performance.closed_loop`; nothing moved.
    """

    def __init__(
        self,
        bench: Bench,
        calibration: CalibrationResult,
        *,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        c = bench.config.loop
        self._bench, self._lock = bench, threading.Lock()
        self._open_requested = False
        first = LoopSettings(
            calibration,
            c.gain if gain is None else gain,
            c.leak if leak is None else leak,
            c.dropped_modes if dropped_modes is None else dropped_modes,
        )
        self._pending: LoopChange | None = self._prepare(first)
        self._requested = first

    @property
    def settings(self) -> LoopSettings:
        """The settings asked for last, in force at the next frames."""
        return self._requested

    @property
    def is_open_requested(self) -> bool:
        """Whether the loop was asked to open."""
        return self._open_requested

    def change(
        self,
        *,
        calibration: CalibrationResult | None = None,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> LoopSettings:
        """Ask for other settings; what is not given stays. Returns all of them.

        Raises
        ------
        ConfigError
            A number that means nothing, or a matrix of other modes or another geometry: open the loop
            for that.
        IncompatibleProduct, CalibrationError
            The matrix belongs elsewhere, or cannot be inverted. The loop goes on as it was.
        """
        with self._lock:
            now = self._requested
            requested = LoopSettings(
                now.calibration if calibration is None else calibration,
                now.gain if gain is None else gain,
                now.leak if leak is None else leak,
                now.dropped_modes if dropped_modes is None else dropped_modes,
            )
            _require_compatible(now.calibration, requested.calibration)
            self._pending = self._prepare(requested)
            self._requested = requested
            return requested

    def open(self) -> None:
        """Ask the loop to open; the mirror will be flat."""
        self._open_requested = True

    def take(self) -> LoopChange | None:
        """What was asked for since the last call; for the loop itself."""
        if self._pending is None:
            return None
        with self._lock:
            change, self._pending = self._pending, None
        return change

    def _prepare(self, requested: LoopSettings) -> LoopChange:
        control = build_integrator(
            self._bench, requested.calibration.matrix, requested.calibration.grid,
            gain=requested.gain, leak=requested.leak, dropped_modes=requested.dropped_modes,
        )  # fmt: skip
        slopes_of = build_slope_function(self._bench, requested.calibration.grid)
        return LoopChange(
            requested, control, slopes_of, _undriven_modes(control.reconstructor, requested.dropped_modes)
        )


def _undriven_modes(reconstructor: NDArray[np.float32], dropped_modes: int) -> NDArray[np.float32]:
    if not dropped_modes:
        return np.zeros((len(reconstructor), 0), np.float32)
    exact = reconstructor.astype(np.float64)
    # By rising eigenvalue, and as many are zero as modes were dropped.
    vectors = np.linalg.eigh(exact @ exact.T)[1]
    return np.ascontiguousarray(vectors[:, :dropped_modes], np.float32)


def _require_compatible(now: CalibrationResult, new: CalibrationResult) -> None:
    """Raise unless two matrices can follow each other in one loop."""
    if new is now:
        return
    if now.matrix.m2c.shape != new.matrix.m2c.shape or not np.allclose(now.matrix.m2c, new.matrix.m2c):
        raise ConfigError("the other matrix is of other modes; open the loop and close it on that matrix")
    same = now.grid.n_slopes == new.grid.n_slopes and np.array_equal(now.grid.valid, new.grid.valid)
    if not same:
        raise ConfigError(
            f"the other matrix marks other {now.grid.elements} as valid; open the loop and close it on "
            "that matrix"
        )
