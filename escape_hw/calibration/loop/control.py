"""The integrator of a matrix, and settings of a running loop that any thread may change."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.offsets import Offsets
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.config import layouts
from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import ConfigError, IncompatibleProduct
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.control.reconstructor import reconstructor


def invert_matrix(matrix: InteractionMatrix, dropped_modes: int) -> NDArray[np.float32]:
    """Reconstructor ``(n_modes, n_slopes)`` of a matrix without its weakest eigenmodes per stroke.

    Raises :class:`CalibrationError` if the matrix cannot be inverted.
    """
    stroke = np.sqrt(np.mean(np.square(matrix.m2c), axis=0))
    return reconstructor(matrix.data, scale=stroke, dropped_modes=dropped_modes)


def build_integrator(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gain: float | None = None,
    leak: float | None = None,
    dropped_modes: int | None = None,
) -> LeakyIntegrator:
    """Build the leaky integrator that closes the loop with a matrix; nothing moves.

    ``gain``, ``leak``, ``dropped_modes``: loop parameters; by default as configured.

    Raises
    ------
    ConfigError
        The gain is outside (0, :data:`~escape_hw.config.system.MAX_GAIN`], or the leak outside [0, 1].
    IncompatibleProduct
        The matrix belongs to another mirror or geometry.
    CalibrationError
        The matrix cannot be inverted.
    """
    c = bench.config.loop
    gain = c.gain if gain is None else gain
    leak = c.leak if leak is None else leak
    if not (0 < gain <= MAX_GAIN and 0 <= leak <= 1):
        raise ConfigError(
            f"gain is {gain} and leak {leak}; the gain must be positive and at most {MAX_GAIN:g}, the leak "
            "in [0, 1]"
        )
    if matrix.m2c.shape[0] != bench.dm.info.n_act or matrix.n_slopes != grid.n_slopes:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators and {matrix.n_slopes} slopes; "
            f"this bench has {bench.dm.info.n_act} and {grid.n_slopes}"
        )
    layouts.require_same_positions(matrix.layout, bench.config.devices.dm.layout, "the matrix")
    if not np.array_equal(matrix.valid, grid.valid):
        raise IncompatibleProduct(f"the matrix and the geometry mark different {grid.elements} as valid")
    dropped = c.dropped_modes if dropped_modes is None else dropped_modes
    return LeakyIntegrator(invert_matrix(matrix, dropped), gain, leak)


NO_OFFSETS = Offsets()


@dataclass(frozen=True, slots=True, eq=False)
class LoopSettings:
    """Settings of a loop: calibration with the matrix that closes it, gain, leak, dropped modes, offsets."""

    calibration: CalibrationResult
    gain: float
    leak: float
    dropped_modes: int
    offsets: Offsets = NO_OFFSETS

    def with_changes(self, **changes: Any) -> LoopSettings:
        """The settings with changes; those that are ``None`` do not count."""
        return replace(self, **{name: value for name, value in changes.items() if value is not None})


@dataclass(frozen=True, slots=True, eq=False)
class LoopChange:
    """New settings, ready to be applied between two frames.

    ``control``, ``slopes_of``: controller, and slope function with the references of the calibration;
    ``undriven``: combinations of modes that the controller does not drive ``(n_modes, n)``, orthonormal.
    """

    settings: LoopSettings
    control: LeakyIntegrator
    slopes_of: SlopeFunction
    undriven: NDArray[np.float32]


class LoopControl:
    """Requests to a running loop, from any thread; the loop applies them between two frames.

    The requesting thread does all slow work, such as the inversion of a matrix.

    Raises
    ------
    ConfigError, IncompatibleProduct, CalibrationError
        As for :func:`build_integrator`; nothing moved.
    """

    def __init__(
        self,
        bench: Bench,
        calibration: CalibrationResult,
        *,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
        offsets: Offsets | None = None,
    ) -> None:
        c = bench.config.loop
        self._bench, self._lock = bench, threading.Lock()
        self._open_requested = False
        configured = LoopSettings(calibration, c.gain, c.leak, c.dropped_modes)
        self._requested = configured.with_changes(
            gain=gain, leak=leak, dropped_modes=dropped_modes, offsets=offsets
        )
        self._pending: LoopChange | None = self._prepare(self._requested)

    @property
    def settings(self) -> LoopSettings:
        """The settings requested last, applied at one of the next frames."""
        return self._requested

    @property
    def is_open_requested(self) -> bool:
        """Whether the loop was asked to open."""
        return self._open_requested

    def request_change(
        self,
        *,
        calibration: CalibrationResult | None = None,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
        offsets: Offsets | None = None,
    ) -> LoopSettings:
        """Request other settings; ``None`` leaves a setting as it is. Returns all requested settings.

        Raises
        ------
        ConfigError
            A number is out of range, or the matrix has other modes or another geometry, for which the loop
            must be opened first.
        IncompatibleProduct, CalibrationError
            As for :func:`build_integrator`. The loop continues unchanged.
        """
        with self._lock:
            now = self._requested
            requested = now.with_changes(
                calibration=calibration, gain=gain, leak=leak, dropped_modes=dropped_modes, offsets=offsets
            )
            _require_exchangeable(now.calibration, requested.calibration)
            self._pending = self._prepare(requested)
            self._requested = requested
            return requested

    def request_open(self) -> None:
        """Request that the loop opens; the mirror will be flat."""
        self._open_requested = True

    def take_change(self) -> LoopChange | None:
        """Return and clear the pending change; ``None`` if there is none. For the loop itself."""
        if self._pending is None:
            return None
        with self._lock:
            change, self._pending = self._pending, None
        return change

    def _prepare(self, requested: LoopSettings) -> LoopChange:
        matrix, grid = requested.calibration.matrix, requested.calibration.grid
        control = build_integrator(
            self._bench, matrix, grid,
            gain=requested.gain, leak=requested.leak, dropped_modes=requested.dropped_modes,
        )  # fmt: skip
        undriven = _undriven_modes(control.reconstructor, requested.dropped_modes)
        slopes_of = build_slope_function(self._bench, grid)
        offset = requested.offsets.reference_slopes(matrix)
        if offset.any():
            slopes_of.shift_references(offset)
        return LoopChange(requested, control, slopes_of, undriven)


def _undriven_modes(reconstructor: NDArray[np.float32], dropped_modes: int) -> NDArray[np.float32]:
    if not dropped_modes:
        return np.zeros((len(reconstructor), 0), np.float32)
    exact = reconstructor.astype(np.float64)
    # Eigenvalues rise, and one is zero per dropped mode.
    vectors = np.linalg.eigh(exact @ exact.T)[1]
    return np.ascontiguousarray(vectors[:, :dropped_modes], np.float32)


def _require_exchangeable(now: CalibrationResult, new: CalibrationResult) -> None:
    """Raise :class:`ConfigError` unless a running loop can change from one matrix to the other."""
    if new is now:
        return
    if now.matrix.m2c.shape != new.matrix.m2c.shape or not np.allclose(now.matrix.m2c, new.matrix.m2c):
        raise ConfigError("the new matrix has other modes than the loop; open the loop first")
    if now.grid.n_slopes != new.grid.n_slopes or not np.array_equal(now.grid.valid, new.grid.valid):
        raise ConfigError(
            f"the new matrix marks other {now.grid.elements} as valid than the loop; open the loop first"
        )
