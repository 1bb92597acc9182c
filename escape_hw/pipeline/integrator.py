"""The leaky integrator."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def _step(matrix, slopes, law, residual, state):  # type: ignore[no-untyped-def]  # pragma: no cover
    """One step, compiled as a whole: in small systems calls cost more than arithmetic."""
    np.dot(matrix, slopes, residual)
    for k in range(state.size):
        state[k] = law[0] * state[k] - law[1] * residual[k]


def gain_limit(delay_frames: float) -> float:
    """Largest stable gain of an integrator behind a pure delay.

    ``2 sin(pi / (2 (2 d - 1)))``, exact for whole delays: 2 for one frame, 1 for two (from the
    phase margin of ``c[k] = c[k-1] - g c[k-d]``).

    Parameters
    ----------
    delay_frames
        Frames from a command to the slopes that show it, at least 1.
    """
    d = max(delay_frames, 1.0)
    return float(2 * np.sin(np.pi / (2 * (2 * d - 1))))


class LeakyIntegrator:
    """Modal leaky integrator ``c <- (1 - leak) c - gain R s`` that knows what was really applied.

    Parameters
    ----------
    reconstructor
        ``(n_modes, n_slopes)``.
    gain
        Loop gain.
    leak
        Share of the state lost per frame.
    """

    def __init__(self, reconstructor: NDArray[np.float32], gain: float, leak: float) -> None:
        if not gain > 0:
            raise ValueError(f"gain is {gain}; it must be positive")
        if not 0 <= leak <= 1:
            raise ValueError(f"leak is {leak}; it must lie in [0, 1]")
        self._matrix = np.ascontiguousarray(reconstructor, np.float32)
        self.gain = gain
        self._law = np.array([1 - leak, gain], np.float32)
        self.state = np.zeros(self._matrix.shape[0], np.float32)
        self.residual = np.zeros(self._matrix.shape[0], np.float32)

    def __call__(self, slopes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Next modal command ``(n_modes,)`` from slopes ``(n_slopes,)``; also sets ``residual``.

        The command and ``residual`` are the same arrays at every call; copy what is to be kept.
        """
        _step(self._matrix, slopes, self._law, self.residual, self.state)
        return self.state

    def applied(self, modes: NDArray[np.floating]) -> None:
        """Tell the integrator what the mirror really did, so that it does not wind up."""
        self.state[:] = modes

    def reset(self) -> None:
        """Forget everything."""
        self.state[:] = 0.0
