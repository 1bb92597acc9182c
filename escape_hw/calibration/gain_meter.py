"""Optical gains from the telemetry of a running loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.lag_sums import ResponseEstimate
from escape_hw.calibration.optical_gain import projector
from escape_hw.errors import TooFewFrames

#: Frames per mode that the noise of the projected slopes is found on.
_FIRST_LOOK = 3


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredGains:
    """Gains as measured.

    Parameters
    ----------
    value, sigma
        ``(n_references, n_modes)``, relative to each reference.
    response
        Response of the sensor to a step of the mirror, what was known before included.
    common_sigma
        Relative standard error that all gains share, from that of the response.
    frames, lost_frames
        That they came from.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: ResponseEstimate
    common_sigma: float
    frames: int
    lost_frames: int

    def mean(self) -> tuple[float, float]:
        """Weighted mean over the modes of the first reference's gains, and its standard error."""
        weights = self.sigma[0] ** -2.0
        value = float(np.average(self.value[0], weights=weights))
        return value, float(np.hypot(weights.sum() ** -0.5, value * self.common_sigma))


class GainMeter:
    """Watches a loop and tells the optical gains of its modes; costs no more than a reconstructor.

    The slopes are projected on the reference's columns first
    (:func:`~escape_hw.calibration.optical_gain.projector`), and what is left, a signal for each mode, goes
    through the estimator of closed-loop DO-CRIME: the matrix that it finds is one between modes, with
    the gains on its diagonal, and its errors know how slopes err together. The signals are turned so
    that their noise is equal and independent, because the temporal response, which all modes share, is
    found by weighing all of them alike. An observer of :class:`~escape_hw.calibration.loop_run.RunningLoop`.

    Parameters
    ----------
    references
        Matrices that gains are wanted relative to, of the same slopes and modes.
    weights
        Of the slopes ``(n_slopes,)``.
    order, lags, known
        As for :class:`~escape_hw.calibration.docrime_estimator.DocrimeEstimator`.
    """

    def __init__(
        self,
        references: Sequence[InteractionMatrix],
        weights: NDArray[np.float64],
        *,
        order: int = 6,
        lags: int = 5,
        known: ResponseEstimate | None = None,
    ) -> None:
        rows = np.concatenate([projector(reference, weights) for reference in references])
        self._rows = np.ascontiguousarray(rows, np.float32)
        self._n_modes, self._order, self._lags, self._known = references[0].n_modes, order, lags, known
        self._signals = np.zeros(len(rows), np.float32)
        self._waiting: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] = []
        self._estimator: DocrimeEstimator | None = None
        self._turn = np.eye(len(rows))

    def __call__(
        self,
        index: int,
        slopes: NDArray[np.float32],
        command: NDArray[np.float64],
        poke: NDArray[np.float64],
    ) -> None:
        """Take one frame, the modal command that answered it and the poke in that command."""
        signals = np.dot(self._rows, slopes, out=self._signals)
        if self._estimator is not None:
            self._estimator.partial_fit(index, signals, command, poke)
            return
        self._waiting.append((index, signals.copy(), np.concatenate([command, poke])))
        if len(self._waiting) >= _FIRST_LOOK * self._n_modes:
            self._begin()

    def solve(self) -> MeasuredGains:
        """The gains so far.

        Raises
        ------
        TooFewFrames
            Fewer complete frames than modes plus a margin.
        CalibrationError
            The sensor does not respond to the pokes.
        """
        n, modes = self._n_modes, np.arange(self._n_modes)
        if self._estimator is None:
            raise TooFewFrames(
                f"{len(self._waiting)} frames tell nothing of {n} modes; {3 * n} at least are needed"
            )
        found = self._estimator.solve()
        if found.covariance is None:
            raise RuntimeError("the estimator was not asked for correlations")
        back = np.linalg.inv(self._turn)
        matrix = (back @ found.matrix).reshape(-1, n, n)
        # An element's variance is the noise of its signal times what the pokes of its mode leave.
        left = np.square(found.sigma[0]) / found.variance[0]
        spread = found.variance / np.diag(found.covariance)
        noise = np.einsum("ij,jk,ik->i", back, found.covariance * np.sqrt(np.outer(spread, spread)), back)
        return MeasuredGains(
            matrix[:, modes, modes],
            np.sqrt(np.maximum(noise, 0).reshape(-1, n) * left),
            ResponseEstimate(found.response.weights, found.response_covariance),
            found.gain_sigma,
            found.frames,
            found.lost_frames,
        )

    def _begin(self) -> None:
        """Find how the signals' noise is correlated, on the first frames, and go on with it turned."""
        n, size = self._n_modes, len(self._rows)
        index = np.array([one[0] for one in self._waiting])
        signals = np.stack([one[1] for one in self._waiting])
        steps = np.diff(signals, axis=0)[np.diff(index) == 1].astype(np.float64)
        for start in range(0, size, n):
            # Each reference by itself: the same slopes stand behind all of them.
            here = slice(start, start + n)
            noise = np.atleast_2d(np.cov(steps[:, here].T))
            noise[np.diag_indices(n)] += 1e-3 * np.trace(noise) / n
            self._turn[here, here] = np.linalg.inv(np.linalg.cholesky(noise))
        self._rows = np.ascontiguousarray(self._turn @ self._rows, np.float32)
        self._estimator = DocrimeEstimator(
            size, n, order=self._order, lags=self._lags, closed=True, known=self._known
        )
        driven = np.stack([one[2] for one in self._waiting])
        self._estimator.extend(index, (signals @ self._turn.T).astype(np.float32), driven)
        self._waiting = []
