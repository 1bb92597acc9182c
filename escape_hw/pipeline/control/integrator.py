"""The leaky integrator and its stability limit."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.pipeline.control.matrix_products import PACKING_BYTES, PackedMatrix


@njit(cache=True, nogil=True)
def _integrate(retention, gains, residual, state):  # type: ignore[no-untyped-def]  # pragma: no cover
    for k in range(state.size):
        state[k] = retention * state[k] - gains[k] * residual[k]


@njit(cache=True, nogil=True)
def _step(matrix, slopes, retention, gains, residual, state):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Reconstruct and integrate; compiled as a whole because calls dominate in small systems."""
    np.dot(matrix, slopes, residual)
    _integrate(retention, gains, residual, state)


def gain_limit(delay_frames: float) -> float:
    """Largest stable gain of an integrator behind a pure delay.

    ``2 sin(pi / (2 (2 d - 1)))``, from the phase margin of ``c[k] = c[k-1] - g c[k-d]``; exact for whole
    delays (2 for one frame, 1 for two).

    ``delay_frames``: frames from a command to the slopes that show it, at least 1.
    """
    d = max(delay_frames, 1.0)
    return float(2 * np.sin(np.pi / (2 * (2 * d - 1))))


class LeakyIntegrator:
    """Modal leaky integrator ``c <- (1 - leak) c - gain R s`` with anti-windup.

    Parameters
    ----------
    reconstructor
        ``(n_modes, n_slopes)``.
    gain
        Loop gain, or one per mode ``(n_modes,)``.
    leak
        Share of the state that is lost per frame.

    Raises
    ------
    ValueError
        A gain is not positive, or the leak not in [0, 1].
    """

    def __init__(
        self, reconstructor: NDArray[np.float32], gain: float | NDArray[np.floating], leak: float
    ) -> None:
        if not 0 <= leak <= 1:
            raise ValueError(f"leak is {leak}; it must lie in [0, 1]")
        self._install(np.ascontiguousarray(reconstructor, np.float32))
        self._retention = np.float32(1 - leak)
        n_modes = self._matrix.shape[0]
        self._gains = np.zeros(n_modes, np.float32)
        self.set_gain(gain)
        self.state = np.zeros(n_modes, np.float32)
        self.residual = np.zeros(n_modes, np.float32)

    @property
    def reconstructor(self) -> NDArray[np.float32]:
        """The reconstructor in use ``(n_modes, n_slopes)``; must not be modified."""
        return self._matrix

    @property
    def gains(self) -> NDArray[np.float32]:
        """Gain of each mode ``(n_modes,)``; a copy."""
        return self._gains.copy()

    def set_gain(self, gain: float | NDArray[np.floating]) -> None:
        """Change the gain, or the gains ``(n_modes,)``; the state is kept.

        Raises
        ------
        ValueError
            A gain is not positive, or the number of gains is wrong.
        """
        gains = np.asarray(gain, float)
        if gains.shape not in ((), self._gains.shape):
            raise ValueError(f"gain has shape {gains.shape}; one number or {self._gains.shape} is needed")
        if not ((gains > 0) & np.isfinite(gains)).all():
            raise ValueError(f"gain is {gain}; it must be positive")
        self._gains[:] = gains

    def set_reconstructor(self, reconstructor: NDArray[np.float32]) -> None:
        """Exchange the reconstructor ``(n_modes, n_slopes)`` without a bump.

        The state, a command in the same modes, is kept, so the next shape of the mirror differs from the
        present one only by the correction from the next slopes.

        Raises
        ------
        ValueError
            The new reconstructor has another shape.
        """
        if reconstructor.shape != self._matrix.shape:
            raise ValueError(
                f"the new reconstructor has shape {reconstructor.shape}, the one in use "
                f"{self._matrix.shape}; another basis or grid needs a new integrator"
            )
        self._install(np.array(reconstructor, np.float32, order="C"))

    def _install(self, matrix: NDArray[np.float32]) -> None:
        self._matrix = matrix
        self._packed = PackedMatrix.of(matrix) if matrix.nbytes > PACKING_BYTES else None

    def __call__(self, slopes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Modal command ``(n_modes,)`` for slopes ``(n_slopes,)``; also sets ``residual``.

        Command and ``residual`` are the same arrays at every call.
        """
        if self._packed is None:
            _step(self._matrix, slopes, self._retention, self._gains, self.residual, self.state)
        else:
            self._packed.product(slopes, self.residual)
            _integrate(self._retention, self._gains, self.residual, self.state)
        return self.state

    def set_applied(self, modes: NDArray[np.floating]) -> None:
        """Set the state to the command that the mirror executed ``(n_modes,)``, against wind-up."""
        self.state[:] = modes

    def reset(self) -> None:
        """Set the state to zero."""
        self.state[:] = 0.0
