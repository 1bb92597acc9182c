"""Optical gains from the telemetry of a running loop, with pokes as instruments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.instruments import InstrumentSums
from escape_hw.calibration.optical_gain import projector
from escape_hw.calibration.response import filtered
from escape_hw.calibration.telemetry import Recorder, Telemetry
from escape_hw.calibration.whitening import apply_filter, prediction_error_filter
from escape_hw.errors import CalibrationError, TooFewFrames

#: Frames that the whitening filter is found on, beside one for each mode.
_BURN_IN = 200
#: Frames gathered before the sums are updated.
_BLOCK = 500
#: Degrees of freedom without which no standard error is worth stating.
_MIN_FREEDOM = 20
#: Standard errors by which the mean response must differ from none.
_CLEARLY = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredGains:
    """Gains as measured.

    Parameters
    ----------
    value, sigma
        ``(n_references, n_modes)``, relative to each reference.
    response
        Response of the sensor to a step of the mirror.
    common_sigma
        Relative standard error that all gains share, from that of the response.
    frames, lost_frames
        That they came from.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: TemporalResponse
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

    The slopes are projected on the reference's columns first (:func:`~escape_hw.calibration.
    optical_gain.projector`), so that what is estimated is a matrix between modes whose diagonal holds
    the gains. The modes' commands are correlated with the turbulence, the pokes are not: they are the
    instruments (``M = (sum y z^T)(sum x z^T)^-1``, see docs/theory/optical-gains.md), and the estimate
    is consistent whatever the controller does. An observer of
    :class:`~escape_hw.calibration.loop_run.RunningLoop`.

    Parameters
    ----------
    references
        Matrices that gains are wanted relative to, of the same slopes and modes.
    weights
        Of the slopes ``(n_slopes,)``.
    order
        Past frames that predict the turbulence.
    lags
        Frames over which the temporal response is estimated.
    """

    def __init__(
        self,
        references: Sequence[InteractionMatrix],
        weights: NDArray[np.float64],
        *,
        order: int = 6,
        lags: int = 5,
    ) -> None:
        rows = [projector(reference, weights) for reference in references]
        self._rows = np.ascontiguousarray(np.concatenate(rows), np.float32)
        self._model = rows[0] @ references[0].data
        self.n_modes, self._order, self._lags = references[0].n_modes, order, lags
        self._n_seen = self._rows.shape[0]
        self._seen = np.zeros(self._n_seen, np.float32)
        self._sent = np.zeros(2 * self.n_modes)
        self._burn_in = _BURN_IN + self.n_modes
        self._recorder = Recorder(self._n_seen, 2 * self.n_modes, self._burn_in)
        self._next: int | None = None
        self._whitener: NDArray[np.float64] | None = None
        self._sums = InstrumentSums(self._n_seen, self.n_modes, lags)
        self._spread, self._spread_rows = np.zeros(self._n_seen), 0
        self.frames = self.lost_frames = 0

    def __call__(
        self,
        index: int,
        slopes: NDArray[np.float32],
        command: NDArray[np.float64],
        poke: NDArray[np.float64],
    ) -> None:
        """Take one frame, the modal command that answered it and the poke in that command."""
        if self._next is not None and index > self._next:
            self._lose(index - self._next)
        np.dot(self._rows, slopes, out=self._seen)
        self._sent[: self.n_modes] = command
        self._sent[self.n_modes :] = poke
        room = self._recorder.take_one(self._seen, self._sent)
        if room < 0:
            raise ValueError(f"frame {index}: slopes or commands are not finite")
        self._next = index + 1
        if not room:
            self._absorb()

    def solve(self) -> MeasuredGains:
        """The gains so far.

        Raises
        ------
        TooFewFrames
            Fewer complete frames than modes plus a margin.
        CalibrationError
            The sensor does not respond to the pokes.
        """
        self._absorb()
        needed = self.n_modes + self._lags + _MIN_FREEDOM
        if self._sums.count < needed:
            raise TooFewFrames(
                f"{self._sums.count} complete frames tell nothing of {self.n_modes} modes; {needed} are needed"
            )
        solution = self._sums.solve(self._model)
        response = solution.response
        if not response.total > _CLEARLY * response.total_sigma:
            raise CalibrationError(
                f"the wavefront sensor does not answer the pokes as the matrix says: {response.total:.3g} ± "
                f"{response.total_sigma:.2g} of its response; check the matrix's sign and modes, that the "
                "light is on, or use larger pokes or more frames"
            )
        variance = np.maximum(np.diag(solution.noise), 0)
        if self._spread_rows:
            variance = variance * self._spread / self._spread_rows
        n, modes = self.n_modes, np.arange(self.n_modes)
        blocks = self._n_seen // n
        value = np.stack([solution.matrix[k * n + modes, modes] for k in range(blocks)])
        sigma = np.sqrt(variance.reshape(blocks, n) * solution.spread)
        common = response.common_sigma
        return MeasuredGains(value, sigma, response.temporal, common, self.frames, self.lost_frames)

    def _lose(self, frames: int) -> None:
        """Lay out lost frames; a gap longer than all memory separates the stretches for good."""
        self.lost_frames += frames
        for _ in range(min(frames, self._memory() + self._order + self._lags)):
            self._recorder.lose_one()
            if self._recorder.full:
                self._absorb()

    def _memory(self) -> int:
        """Rows before a row that its filtered columns are made of."""
        return 2 * self._order + self._lags

    def _absorb(self) -> None:
        """Move the gathered frames into the sums; find the filter first if there is none yet."""
        recorder = self._recorder
        data, start = recorder.telemetry(), recorder.kept
        if self._whitener is None:
            if recorder.filled < self._burn_in:
                return
            self._whitener, start = self._filter(data), 0
        self.frames += recorder.fresh
        block = self._sums.add(filtered(data, self._whitener, self._lags, start))
        if block is not None and self._sums.count > 2 * self.n_modes:
            self._spread += self._sums.spread(block, self._model) * len(block.slopes)
            self._spread_rows += len(block.slopes)
        recorder.keep(self._memory())
        if start == 0:
            recorder.resize(recorder.filled + _BLOCK)

    def _filter(self, data: Telemetry) -> NDArray[np.float64]:
        """The filter that whitens what the mirror did not make: the turbulence, not what is left of it."""
        closed = prediction_error_filter(data.slopes, data.present, self._order)
        first = InstrumentSums(self._n_seen, self.n_modes, self._lags)
        first.add(filtered(data, closed, self._lags))
        free = first.solve(self._model).response
        if not free.total > _CLEARLY * free.total_sigma:
            return closed
        at = data.complete(0, self._lags)
        commands = apply_filter(data.rows, free.total * free.temporal.weights, at, self._n_seen)
        n = self.n_modes
        open_loop = np.zeros((data.present.size, n), np.float32)
        open_loop[at] = data.slopes[at, :n] - commands[:, :n] @ self._model.T.astype(np.float32)
        present = np.zeros_like(data.present)
        present[at] = True
        return prediction_error_filter(open_loop, present, self._order)
