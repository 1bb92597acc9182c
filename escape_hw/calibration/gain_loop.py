"""A running loop that measures its own optical gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import next_frame
from escape_hw.calibration.closed_loop import integrator_for
from escape_hw.calibration.gain_meter import GainMeter, MeasuredGains
from escape_hw.calibration.lag_sums import ResponseEstimate
from escape_hw.calibration.loop_run import LoopRecord, RunningLoop
from escape_hw.calibration.optical_gain import scaled_matrix, slope_weights
from escape_hw.calibration.poke_patterns import RandomPokes
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor
from escape_hw.calibration.stopping import GROWTH
from escape_hw.errors import CalibrationError, IncompatibleProduct, TooFewFrames
from escape_hw.pipeline.integrator import LeakyIntegrator
from escape_hw.pipeline.reconstructor import reconstructor

#: Frames after a change of gain or reconstructor that count for nothing.
SETTLING = 60
#: Frames between two looks at a running loop.
_STRETCH = 500


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """What a stretch of the loop told: gains (``None``: no answer to the pokes), residual in nm."""

    gains: MeasuredGains | None
    residual_nm: float
    frames: int
    diverged: bool
    record: LoopRecord
    why: str = ""


class GainLoop:
    """A loop whose pokes measure the optical gains of its matrix, and whose matrix can be scaled.

    Mirror and sensor answer in the same time from one measurement to the next, whatever the gains do: each
    goes on with the temporal response that those before it found, from larger pokes as a rule. Whoever
    makes one calls :meth:`open_again` in a ``finally``.

    Parameters
    ----------
    bench
        An open bench.
    calibration
        The matrix that closes the loop, with its geometry.
    beside
        Other matrices of the same geometry and modes whose gains are wanted, too.
    science
        Whether to gather the frames of the science camera.

    Raises
    ------
    ConfigError, IncompatibleProduct, CalibrationError
        The matrix cannot close this loop; nothing moved.
    """

    def __init__(
        self,
        bench: Bench,
        calibration: CalibrationResult,
        beside: Mapping[str, InteractionMatrix],
        *,
        science: bool = False,
    ) -> None:
        self.bench, self.reference = bench, calibration.matrix
        for name, matrix in beside.items():
            _require_like(self.reference, name, matrix)
        self._references = [self.reference, *beside.values()]
        self._weights = slope_weights(calibration.measured or self.reference)
        self.control: LeakyIntegrator = integrator_for(bench, self.reference, calibration.grid)
        self._dropped = bench.config.loop.dropped_modes
        self._stroke = np.sqrt(np.mean(np.square(self.reference.m2c), axis=0))
        self._known: ResponseEstimate | None = None
        # Refused here, before anything moves, if a mode is noise.
        self._meter = self._new_meter()
        prepare_sensor(bench)
        slopes_of = extractor(bench, calibration.grid)
        self._loop = RunningLoop(bench, self.reference.m2c, slopes_of, self.control, science=science)
        self._science = bench.science if science else None
        self.frames = 0

    def start(self) -> None:
        """Flatten the mirror and read the first frame; what was lost before is no loss of the loop."""
        self.bench.dm.flatten()
        next_frame(self.bench)
        if self._science is not None:
            self._science.stop()

    def open_again(self) -> None:
        """Open the loop: the mirror flat, the controller without memory."""
        self.bench.dm.flatten()
        self.control.reset()
        if self._science is not None:
            self._science.stop()

    def scale(self, gains: NDArray[np.float64]) -> None:
        """Go on with the matrix scaled by gains ``(n_modes,)``, without a bump.

        Raises
        ------
        CalibrationError
            The scaled matrix cannot be inverted.
        """
        matrix = scaled_matrix(self.reference, gains)
        self.control.set_reconstructor(
            reconstructor(matrix.data, scale=self._stroke, dropped_modes=self._dropped)
        )

    def measure(
        self,
        frames: int,
        amplitude: NDArray[np.float64],
        stage: str,
        *,
        most: int | None = None,
        enough: Callable[[MeasuredGains], bool] = lambda gains: True,
    ) -> Procedure[Stretch]:
        """Poke and measure the gains, the loop staying closed.

        Parameters
        ----------
        frames
            Fewest frames.
        amplitude
            Of each mode's pokes ``(n_modes,)``.
        stage
            Name of the stage in progress reports.
        most
            Frames to go on to until ``enough``; as ``frames`` by default.
        enough
            Asked now and then.
        """
        most = frames if most is None else max(most, frames)
        pokes, loop, meter = RandomPokes(amplitude, self.bench.rng), self._loop, self._new_meter()
        self._meter = meter
        report = Reporter(stage, most)
        loop.record = LoopRecord()
        yield from loop.run(SETTLING, inject=pokes, report=report)
        skipped, done, look = len(loop.record.residual), 0, frames
        gains, why = None, ""
        while done < most and not loop.record.diverged:
            step = min(_STRETCH, look - done)
            yield from loop.run(step, inject=pokes, observe=(meter,), report=report)
            done += step
            if done < look or loop.record.diverged:
                continue
            look = min(most, int(look * GROWTH) + 1)
            gains, why = _solved(meter)
            if gains is not None and enough(gains):
                break
        self.frames += loop.record.frames
        if gains is not None and not loop.record.diverged:
            self._known = gains.response
        residual = np.array(loop.record.residual[skipped:])
        rms = float(np.sqrt(np.mean(np.square(residual)))) if residual.size else math.nan
        return Stretch(gains, rms, done, loop.record.diverged, loop.record, why)

    def so_far(self) -> MeasuredGains | None:
        """What the last measurement found, also when it was aborted; ``None`` if it was too short."""
        return _solved(self._meter)[0]

    def _new_meter(self) -> GainMeter:
        c = self.bench.config.calibration
        return GainMeter(
            self._references, self._weights, order=c.whiten_order, lags=c.lags, known=self._known
        )


def _require_like(reference: InteractionMatrix, name: str, matrix: InteractionMatrix) -> None:
    """Raise :class:`IncompatibleProduct` unless a matrix has the reference's slopes and modes."""
    if not np.array_equal(matrix.valid, reference.valid):
        raise IncompatibleProduct(
            f"{name} was measured on other sub-apertures than the matrix that closes the loop, so its gains "
            "cannot be told; measure it on the same geometry (grid= of the calibration)"
        )
    if matrix.m2c.shape != reference.m2c.shape or not np.allclose(matrix.m2c, reference.m2c):
        raise IncompatibleProduct(f"{name} is of other modes than the matrix that closes the loop")


def _solved(meter: GainMeter) -> tuple[MeasuredGains | None, str]:
    """The gains, or why there are none."""
    try:
        return meter.solve(), ""
    except (TooFewFrames, CalibrationError) as error:
        return None, str(error)
