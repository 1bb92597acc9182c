"""The leaky integrator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
        self._keep, self._gain = np.float32(1 - leak), np.float32(gain)
        self.state = np.zeros(self._matrix.shape[0], np.float32)
        self.residual = np.zeros(self._matrix.shape[0], np.float32)

    def __call__(self, slopes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Next modal command ``(n_modes,)`` from slopes ``(n_slopes,)``; also sets ``residual``."""
        np.dot(self._matrix, slopes, out=self.residual)
        self.state = self._keep * self.state - self._gain * self.residual
        return self.state

    def applied(self, modes: NDArray[np.floating]) -> None:
        """Tell the integrator what the mirror really did, so that it does not wind up."""
        self.state = np.array(modes, dtype=np.float32)

    def reset(self) -> None:
        """Forget everything."""
        self.state = np.zeros_like(self.state)
