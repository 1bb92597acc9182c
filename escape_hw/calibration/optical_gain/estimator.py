"""Optical gains from the telemetry of a closed loop with pokes: the loop, and the streaming estimator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import RandomPokes
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.monitor import CHECK_GROWTH
from escape_hw.calibration.docrime.response import ResponseEstimate
from escape_hw.calibration.loop.control import build_integrator, invert_matrix
from escape_hw.calibration.loop.runner import LoopRecord, RunningLoop
from escape_hw.calibration.optical_gain.matrix_comparison import projector, scale_matrix, slope_weights
from escape_hw.errors import CalibrationError, IncompatibleProduct, TooFewFrames
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.statistics import root_mean_square

#: Frames per mode from which the noise of the projected slopes is estimated.
_NOISE_FRAMES_PER_MODE = 3


@dataclass(frozen=True, slots=True, eq=False)
class OpticalGainEstimate:
    """Optical gains estimated from telemetry.

    Parameters
    ----------
    value, sigma
        Gains and standard errors ``(n_references, n_modes)``, relative to each reference.
    response
        Temporal response, earlier measurements included.
    common_sigma
        Relative standard error common to all gains, from that of the response.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: ResponseEstimate
    common_sigma: float
    frames: int
    lost_frames: int

    def mean(self) -> tuple[float, float]:
        """Weighted mean of the gains relative to the first reference, and its standard error."""
        weights = self.sigma[0] ** -2.0
        value = float(np.average(self.value[0], weights=weights))
        return value, float(np.hypot(weights.sum() ** -0.5, value * self.common_sigma))


class OpticalGainEstimator:
    """Streaming estimator of the optical gains; costs no more per frame than a reconstructor.

    The slopes are projected on the columns of each reference
    (:func:`~escape_hw.calibration.optical_gain.matrix_comparison.projector`), and the resulting signals, one
    per mode, are processed by the estimator of closed-loop DO-CRIME: its matrix is one between modes, with
    the gains on the diagonal, and its errors include the correlation of the slopes. The signals are whitened
    over the modes first, because the temporal response, common to all modes, is fitted with equal weights.
    An observer of :class:`~escape_hw.calibration.loop.runner.RunningLoop`.

    Parameters
    ----------
    references
        Matrices relative to which gains are estimated, of the same slopes and modes.
    weights
        Weights of the slopes ``(n_slopes,)``.
    order, lags, known_response
        As for :class:`~escape_hw.calibration.docrime.estimator.DocrimeEstimator`.
    """

    def __init__(
        self,
        references: Sequence[InteractionMatrix],
        weights: NDArray[np.float64],
        *,
        order: int = 6,
        lags: int = 5,
        known_response: ResponseEstimate | None = None,
    ) -> None:
        rows = np.concatenate([projector(reference, weights) for reference in references])
        self._rows = np.ascontiguousarray(rows, np.float32)
        self._n_modes, self._order, self._lags = references[0].n_modes, order, lags
        self._known_response = known_response
        self._signals = np.zeros(len(rows), np.float32)
        self._pending_frames: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] = []
        self._estimator: DocrimeEstimator | None = None
        self._signal_whitening = np.eye(len(rows))

    def __call__(
        self, index: int, slopes: NDArray[np.float32], command: NDArray[np.float64], poke: NDArray[np.float64]
    ) -> None:
        """Add a frame, the modal command computed from it, and the poke in that command."""
        signals = np.dot(self._rows, slopes, out=self._signals)
        if self._estimator is not None:
            self._estimator.partial_fit(index, signals, command, poke)
            return
        self._pending_frames.append((index, signals.copy(), np.concatenate([command, poke])))
        if len(self._pending_frames) >= _NOISE_FRAMES_PER_MODE * self._n_modes:
            self._start_estimator()

    def solve(self) -> OpticalGainEstimate:
        """The gains from the frames so far.

        Raises
        ------
        TooFewFrames
            Too few complete frames.
        CalibrationError
            The sensor does not respond to the pokes.
        """
        n, modes = self._n_modes, np.arange(self._n_modes)
        if self._estimator is None:
            raise TooFewFrames(
                f"{len(self._pending_frames)} frames cannot constrain the gains of {n} modes; at least "
                f"{3 * n} are needed"
            )
        solution = self._estimator.solve()
        if solution.covariance is None:
            raise RuntimeError("the estimator did not compute the covariance of the noise")
        inverse_whitening = np.linalg.inv(self._signal_whitening)
        matrix = (inverse_whitening @ solution.matrix).reshape(-1, n, n)
        # Variance of an element: noise of its signal over the power of the pokes of its mode.
        inverse_poke_power = np.square(solution.sigma[0]) / solution.variance[0]
        spread = solution.variance / np.diag(solution.covariance)
        covariance = solution.covariance * np.sqrt(np.outer(spread, spread))
        noise = np.einsum("ij,jk,ik->i", inverse_whitening, covariance, inverse_whitening)
        return OpticalGainEstimate(
            matrix[:, modes, modes],
            np.sqrt(np.maximum(noise, 0).reshape(-1, n) * inverse_poke_power),
            ResponseEstimate(solution.response.weights, solution.response_covariance),
            solution.gain_sigma, solution.frames, solution.lost_frames,
        )  # fmt: skip

    def _start_estimator(self) -> None:
        """Whiten the signals over the modes by the noise of the first frames, and start the estimator."""
        n, size = self._n_modes, len(self._rows)
        index = np.array([one[0] for one in self._pending_frames])
        signals = np.stack([one[1] for one in self._pending_frames])
        steps = np.diff(signals, axis=0)[np.diff(index) == 1].astype(np.float64)
        for start in range(0, size, n):
            # The signals of different references are combinations of the same slopes.
            block = slice(start, start + n)
            noise = np.atleast_2d(np.cov(steps[:, block].T))
            noise[np.diag_indices(n)] += 1e-3 * np.trace(noise) / n
            self._signal_whitening[block, block] = np.linalg.inv(np.linalg.cholesky(noise))
        self._rows = np.ascontiguousarray(self._signal_whitening @ self._rows, np.float32)
        self._estimator = DocrimeEstimator(
            size, n, order=self._order, lags=self._lags, closed=True, known_response=self._known_response
        )
        commands_and_pokes = np.stack([one[2] for one in self._pending_frames])
        self._estimator.extend(
            index, (signals @ self._signal_whitening.T).astype(np.float32), commands_and_pokes
        )
        self._pending_frames = []


#: Frames after a change of gain or reconstructor that are not used.
SETTLING_FRAMES = 60
#: Frames between two progress reports of the loop.
_SEGMENT_FRAMES = 500


@dataclass(frozen=True, slots=True, eq=False)
class LoopSegment:
    """A measurement in closed loop: gains (``None`` for the stated ``reason``), residual in nm."""

    gains: OpticalGainEstimate | None
    residual_nm: float
    frames: int
    diverged: bool
    record: LoopRecord
    reason: str = ""


class GainMeasurementLoop:
    """A closed loop with pokes that measure the optical gains of its matrix, which can be rescaled.

    The temporal response does not depend on the gains, so each measurement uses that of the earlier ones,
    which usually had larger pokes. Measure within ``with loop.closed():``.

    ``comparisons``: other matrices of the same geometry and modes whose gains are measured as well.

    Raises
    ------
    ConfigError, IncompatibleProduct, CalibrationError
        The matrix cannot close this loop; nothing moved.
    """

    def __init__(
        self,
        bench: Bench,
        calibration: CalibrationResult,
        comparisons: Mapping[str, InteractionMatrix],
        *,
        science: bool = False,
    ) -> None:
        self.bench, self.reference = bench, calibration.matrix
        for name, matrix in comparisons.items():
            _require_same_modes(self.reference, name, matrix)
        self._references = [self.reference, *comparisons.values()]
        self._weights = slope_weights(calibration.measured or self.reference)
        self.control: LeakyIntegrator = build_integrator(bench, self.reference, calibration.grid)
        self._known_response: ResponseEstimate | None = None
        # Raises, before anything moves, if a mode is dominated by noise.
        self._estimator = self._new_estimator()
        self._loop = RunningLoop.prepare(
            bench, self.reference, calibration.grid, self.control, science=science
        )
        self.frames = 0

    def closed(self) -> AbstractContextManager[None]:
        """Context in which the loop is closed: the mirror is flattened on entry and on exit."""
        return self._loop.closed()

    @property
    def lost_frames(self) -> int:
        """Frames that the camera lost since the loop was closed."""
        return self._loop.lost_frames

    def open_loop(self) -> None:
        """Flatten the mirror and reset the controller."""
        self._loop.open()
        self.control.reset()

    def scale(self, gains: NDArray[np.float64]) -> None:
        """Exchange the reconstructor, bumplessly, for that of the matrix scaled by gains ``(n_modes,)``.

        Raises :class:`CalibrationError` if the scaled matrix cannot be inverted.
        """
        matrix = scale_matrix(self.reference, gains)
        self.control.set_reconstructor(invert_matrix(matrix, self.bench.config.loop.dropped_modes))

    def measure(
        self,
        frames: int,
        amplitude: NDArray[np.float64],
        stage: str,
        *,
        max_frames: int | None = None,
        is_sufficient: Callable[[OpticalGainEstimate], bool] = lambda gains: True,
    ) -> Procedure[LoopSegment]:
        """Poke and measure the gains in closed loop.

        Parameters
        ----------
        frames
            Smallest number of frames.
        amplitude
            Amplitude of the pokes ``(n_modes,)``.
        max_frames
            Largest number of frames; ``frames`` by default.
        is_sufficient
            Criterion to stop, checked each time the number of frames has grown by a factor.
        """
        max_frames = frames if max_frames is None else max(max_frames, frames)
        pokes, loop, estimator = RandomPokes(amplitude, self.bench.rng), self._loop, self._new_estimator()
        self._estimator = estimator
        report = Reporter(stage, max_frames)
        loop.record = LoopRecord()
        yield from loop.run(SETTLING_FRAMES, inject=pokes, report=report)
        n_settling, done, next_check = len(loop.record.residual), 0, frames
        gains, reason = None, ""
        while done < max_frames and not loop.record.diverged:
            step = min(_SEGMENT_FRAMES, next_check - done)
            yield from loop.run(step, inject=pokes, observe=(estimator,), report=report)
            done += step
            if done < next_check or loop.record.diverged:
                continue
            next_check = min(max_frames, int(next_check * CHECK_GROWTH) + 1)
            gains, reason = _try_solve(estimator)
            if gains is not None and is_sufficient(gains):
                break
        self.frames += loop.record.frames
        if gains is not None and not loop.record.diverged:
            self._known_response = gains.response
        residual = np.array(loop.record.residual[n_settling:])
        rms = root_mean_square(residual)
        return LoopSegment(gains, rms, done, loop.record.diverged, loop.record, reason)

    def solve_latest(self) -> OpticalGainEstimate | None:
        """Gains of the last measurement, even if aborted; ``None`` if it was too short."""
        return _try_solve(self._estimator)[0]

    def _new_estimator(self) -> OpticalGainEstimator:
        c = self.bench.config.calibration
        return OpticalGainEstimator(
            self._references, self._weights, order=c.whiten_order, lags=c.lags,
            known_response=self._known_response,
        )  # fmt: skip


def _require_same_modes(reference: InteractionMatrix, name: str, matrix: InteractionMatrix) -> None:
    """Raise :class:`IncompatibleProduct` unless a matrix has the reference's slopes and modes."""
    if not np.array_equal(matrix.valid, reference.valid):
        raise IncompatibleProduct(
            f"{name} was measured on other sub-apertures than the matrix that closes the loop, so its gains "
            "cannot be measured; measure it on the same geometry (grid= of the calibration)"
        )
    if matrix.m2c.shape != reference.m2c.shape or not np.allclose(matrix.m2c, reference.m2c):
        raise IncompatibleProduct(f"{name} is of other modes than the matrix that closes the loop")


def _try_solve(estimator: OpticalGainEstimator) -> tuple[OpticalGainEstimate | None, str]:
    """The gains, or the reason why there are none."""
    try:
        return estimator.solve(), ""
    except (TooFewFrames, CalibrationError) as error:
        return None, str(error)
