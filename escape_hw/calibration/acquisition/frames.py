"""Frames in, slopes out, with the mirror's record beside: what every procedure does."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.mirror import DeformableMirror, SendReport
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.mean_focus import StaticFocusEstimator
from escape_hw.errors import CalibrationError, ConfigError

#: So many frames in a row with half of the sub-apertures dark mean that the light has gone ...
DARK_FRAMES = 25
#: ... and dark is a sub-aperture with less than this share of its usual light.
DARK_FRACTION = 0.02
#: Frames after which a poke is gone from the slopes, and the air is not.
_LAG_FRAMES = 2
#: Blocks of a run at most whose means tell how fast slopes forget; half as many at least.
_MAX_BLOCKS = 8
#: Share of the air in the slopes' variance below which it cannot be told from chance.
_MIN_TURBULENCE_FRACTION = 0.02


def validate_frame_count(frames: int, name: str = "frames") -> int:
    """The number of frames, if it is a whole number and at least one.

    Raises
    ------
    ConfigError
        It is not.
    """
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer):
        raise ConfigError(f"{name} is {frames!r}; it must be a whole number")
    if frames < 1:
        raise ConfigError(f"{name} is {frames}; it must be at least 1")
    return frames


class FluxMonitor:
    """Notices that the sensor has gone dark: slopes of nothing are noise, or zero, which looks perfect.

    Parameters
    ----------
    device
        Name of the camera, for the message.
    grid
        Tells how much light is usual, and what the sub-apertures are called.
    """

    def __init__(self, device: str, grid: SensorGeometry) -> None:
        self._camera_name, self._element_name = device, grid.elements
        self._min_flux = DARK_FRACTION * grid.counts * grid.flux[grid.valid]
        self._dark_frames = 0

    def __call__(self, flux: NDArray[np.float32]) -> None:
        """Look at the flux of every sub-aperture in one frame ``(n_valid,)``.

        Raises
        ------
        CalibrationError
            No light for :data:`DARK_FRAMES` frames in a row.
        """
        self._dark_frames = (
            self._dark_frames + 1 if 2 * np.count_nonzero(flux > self._min_flux) < flux.size else 0
        )
        if self._dark_frames >= DARK_FRAMES:
            raise CalibrationError(
                f"{self._camera_name}: no light on most {self._element_name} for {self._dark_frames} frames in a row; "
                "check the source, the beam stop and the exposure"
            )


class SlopeStatistics:
    """Running mean, rms and correlation over time of the slopes, and the rms of the pokes beside them."""

    def __init__(self, n_slopes: int) -> None:
        self.n_slopes = n_slopes
        self._n_frames = 0
        self._sum = np.zeros(n_slopes)
        self._sum_of_squares = np.zeros(n_slopes)
        self._poke_power = self._lag_products = 0.0
        self._n_lag_pairs = 0
        self._recent_slopes: deque[NDArray[np.float32]] = deque(maxlen=_LAG_FRAMES)
        self._blocks, self._block_length = [np.zeros(n_slopes)], 1

    def add(self, slopes: NDArray[np.float32], poke: NDArray[np.float64] | None = None) -> None:
        """Take the slopes of one frame ``(n_slopes,)``, and the poke in modes of unit rms surface."""
        if self._n_frames == self._block_length * len(self._blocks):
            if len(self._blocks) == _MAX_BLOCKS:
                self._blocks = [a + b for a, b in zip(self._blocks[::2], self._blocks[1::2], strict=True)]
                self._block_length *= 2
            self._blocks.append(np.zeros(self.n_slopes))
        self._blocks[-1] += slopes
        if len(self._recent_slopes) == _LAG_FRAMES:
            self._lag_products += float(self._recent_slopes[0] @ slopes)
            self._n_lag_pairs += 1
        self._recent_slopes.append(slopes.copy())
        self._n_frames += 1
        self._sum += slopes
        self._sum_of_squares += np.square(slopes, dtype=np.float64)
        if poke is not None:
            self._poke_power += float(poke @ poke)

    def extend(self, slopes: NDArray[np.float32]) -> None:
        """Take the slopes of many frames ``(n, n_slopes)``."""
        self._n_frames += len(slopes)
        self._sum += slopes.sum(axis=0, dtype=np.float64)
        self._sum_of_squares += np.einsum("ts,ts->s", slopes, slopes, dtype=np.float64)

    def state(self) -> NDArray[np.float64]:
        """All sums with the number of frames behind them ``(7 + blocks, n_slopes)``."""
        numbers = (
            float(self._n_frames),
            self._poke_power,
            self._lag_products,
            float(self._n_lag_pairs),
            float(self._block_length),
        )
        rows = (np.full(self.n_slopes, number) for number in numbers)
        return np.stack([self._sum, self._sum_of_squares, *rows, *self._blocks])

    def restore(self, state: NDArray[np.float64]) -> None:
        """Go on from what :meth:`state` gave."""
        self._sum, self._sum_of_squares, self._n_frames = state[0].copy(), state[1].copy(), int(state[2, 0])
        self._poke_power, self._lag_products = float(state[3, 0]), float(state[4, 0])
        self._n_lag_pairs, self._block_length = int(state[5, 0]), int(state[6, 0])
        self._blocks = [row.copy() for row in state[7:]]
        self._recent_slopes.clear()

    def annotate_geometry(self, grid: SensorGeometry, *, closed: bool = False) -> SensorGeometry:
        """The geometry with the motion filled in; in closed loop what lasts of it is not the air's."""
        if self._n_frames < 2:
            return grid
        variance = float(
            np.maximum(
                self._sum_of_squares / self._n_frames - np.square(self._sum / self._n_frames), 0
            ).mean()
        )
        poke_rms, persistent_fraction = (
            float(np.sqrt(self._poke_power / self._n_frames)),
            self._persistence(variance),
        )
        n_effective = self._effective_samples(variance, persistent_fraction if poke_rms else 1.0)
        return grid.with_slope_statistics(
            float(np.sqrt(variance)), poke_rms, n_effective, 0.0 if closed else persistent_fraction
        )

    def _persistence(self, variance: float) -> float:
        """Correlation of the slopes with those :data:`_LAG_FRAMES` frames later, between 0 and 1."""
        if not self._n_lag_pairs or not variance > 0:
            return 0.0
        mean = float(np.square(self._sum / self._n_frames).sum())
        return float(
            np.clip((self._lag_products / self._n_lag_pairs - mean) / (variance * self.n_slopes), 0.0, 1.0)
        )

    def _effective_samples(self, variance: float, share: float) -> float:
        """Independent states of the air seen so far: by how much means over blocks vary less.

        The variance of a mean over ``L`` frames is ``variance * tau / L`` with the integral of the
        correlation ``tau``, once ``L`` exceeds it. Pokes are new in every frame: all but the air's
        ``share`` of the variance has a ``tau`` of one frame, and the air's is as much longer.
        """
        complete_blocks = self._blocks[: self._n_frames // self._block_length]
        if len(complete_blocks) < _MAX_BLOCKS // 2 or not variance > 0:
            return 0.0
        block_variance = float(np.var(np.stack(complete_blocks) / self._block_length, axis=0, ddof=1).mean())
        tau = self._block_length * block_variance / variance
        if share > _MIN_TURBULENCE_FRACTION:
            tau = (tau - 1 + share) / share
        return self._n_frames / max(tau, 1.0)

    def update_references(
        self, grid: SensorGeometry, focus_estimator: StaticFocusEstimator | None = None
    ) -> SensorGeometry:
        """The geometry with the references that all frames of a run give, instead of its first ones.

        ``focus_estimator``, which saw the same frames, takes out what the wind explains of the mean focus.
        """
        if self._n_frames < 2:
            return grid
        mean = self._sum / self._n_frames
        return grid.with_mean_slopes(mean if focus_estimator is None else focus_estimator.correct_mean(mean))


def limit_to_reachable(dm: DeformableMirror, shape: NDArray[np.float64]) -> NDArray[np.float64]:
    """The command nearest to a shape that the mirror may take at once, on the way there.

    The shape is scaled to obey the limits, and the way to it cut short by the slew limit, so what is
    sent stays in the span of the modes that shape and present shape are made of. The guard would cut
    off single actuators, and the rest would pass for a response of the modes.

    Parameters
    ----------
    dm
        The mirror.
    shape
        ``(n_act,)``.
    """
    now, target = dm.shape, shape * dm.largest_legal_scale(shape)
    slew, furthest = dm.limits.max_slew, float(np.abs(target - now).max(initial=0.0))
    if slew is None or furthest <= slew:
        return target
    return np.asarray(now + (target - now) * (slew / furthest))


def ramp_to(dm: DeformableMirror, shape: NDArray[np.float64]) -> SendReport:
    """Take a shape, scaled to obey the limits, in as many commands as the slew limit asks for.

    Returns
    -------
    SendReport
        Of the last command; its ``sent`` is the shape that the mirror has.
    """
    while True:
        before = dm.shape
        report = dm.send(limit_to_reachable(dm, shape))
        if not np.any(report.sent != before) or dm.limits.max_slew is None:
            return report
        remaining = shape * dm.largest_legal_scale(shape) - report.sent
        if float(np.abs(remaining).max(initial=0.0)) <= 1e-9:
            return report


def next_frame(bench: Bench) -> Frame:
    """The sensor's next frame within the configured time-out."""
    return bench.wfs.next_frame(bench.config.devices.wfs.timeout_s)


def build_interaction_matrix(
    bench: Bench,
    grid: SensorGeometry,
    m2c: NDArray[np.float64],
    data: NDArray[np.float64],
    sigma: NDArray[np.float64],
    method: str,
    **metrics: float | int | str,
) -> InteractionMatrix:
    """An interaction matrix of this bench with its provenance."""
    return InteractionMatrix(
        data.astype(np.float32),
        sigma.astype(np.float32),
        m2c,
        grid.valid,
        bench.config.system.name,
        method,
        bench.simulated,
        dict(metrics),
        grid.slope_unit,
    )
