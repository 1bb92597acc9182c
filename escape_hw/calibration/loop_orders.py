"""What is asked of a loop that runs: another gain, leak, matrix, or to open; from any thread."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.sensor_setup import extractor
from escape_hw.errors import ConfigError
from escape_hw.pipeline.integrator import LeakyIntegrator


@dataclass(frozen=True, slots=True, eq=False)
class LoopSettings:
    """Settings of a loop.

    Parameters
    ----------
    closing
        The calibration whose matrix closes it.
    """

    closing: CalibrationResult
    gain: float
    leak: float
    dropped_modes: int


@dataclass(frozen=True, slots=True, eq=False)
class Change:
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
    outside: NDArray[np.float32]


class LoopOrders:
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
        As for :func:`~escape_hw.calibration.closed_loop.closed_loop`; nothing moved.
    """

    def __init__(
        self,
        bench: Bench,
        closing: CalibrationResult,
        *,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
    ) -> None:
        c = bench.config.loop
        self._bench, self._asking = bench, threading.Lock()
        self._opened = False
        first = LoopSettings(
            closing,
            c.gain if gain is None else gain,
            c.leak if leak is None else leak,
            c.dropped_modes if dropped_modes is None else dropped_modes,
        )
        self._change: Change | None = self._prepared(first)
        self._wanted = first

    @property
    def settings(self) -> LoopSettings:
        """The settings asked for last, in force at the next frames."""
        return self._wanted

    @property
    def opened(self) -> bool:
        """Whether the loop was asked to open."""
        return self._opened

    def change(
        self,
        *,
        closing: CalibrationResult | None = None,
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
        with self._asking:
            now = self._wanted
            wanted = LoopSettings(
                now.closing if closing is None else closing,
                now.gain if gain is None else gain,
                now.leak if leak is None else leak,
                now.dropped_modes if dropped_modes is None else dropped_modes,
            )
            _require_same_frame(now.closing, wanted.closing)
            self._change = self._prepared(wanted)
            self._wanted = wanted
            return wanted

    def open(self) -> None:
        """Ask the loop to open; the mirror will be flat."""
        self._opened = True

    def take(self) -> Change | None:
        """What was asked for since the last call; for the loop itself."""
        if self._change is None:
            return None
        with self._asking:
            change, self._change = self._change, None
        return change

    def _prepared(self, wanted: LoopSettings) -> Change:
        control = integrator_for(
            self._bench, wanted.closing.matrix, wanted.closing.grid,
            gain=wanted.gain, leak=wanted.leak, dropped_modes=wanted.dropped_modes,
        )  # fmt: skip
        slopes_of = extractor(self._bench, wanted.closing.grid)
        return Change(wanted, control, slopes_of, _outside(control.reconstructor, wanted.dropped_modes))


def _outside(reconstructor: NDArray[np.float32], dropped_modes: int) -> NDArray[np.float32]:
    if not dropped_modes:
        return np.zeros((len(reconstructor), 0), np.float32)
    exact = reconstructor.astype(np.float64)
    # By rising eigenvalue, and as many are zero as modes were dropped.
    vectors = np.linalg.eigh(exact @ exact.T)[1]
    return np.ascontiguousarray(vectors[:, :dropped_modes], np.float32)


def _require_same_frame(now: CalibrationResult, new: CalibrationResult) -> None:
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
