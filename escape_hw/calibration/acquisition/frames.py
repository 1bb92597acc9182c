"""Frames, flux check, and commands within the mirror's limits, as all procedures use them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.mirror import DeformableMirror, SendReport
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.errors import CalibrationError, ConfigError

#: Consecutive frames with most sub-apertures dark after which the light counts as lost.
DARK_FRAMES = 25
#: Share of its usual flux below which a sub-aperture is dark.
DARK_FRACTION = 0.02


def validate_frame_count(frames: int) -> int:
    """Return a number of frames; raise :class:`ConfigError` unless it is an integer of at least one."""
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer):
        raise ConfigError(f"frames is {frames!r}; it must be a whole number")
    if frames < 1:
        raise ConfigError(f"frames is {frames}; it must be at least 1")
    return frames


class FluxMonitor:
    """Detects that the sensor has gone dark.

    Without light slopes are noise or exactly zero, which would pass for a perfect wavefront.

    ``grid``: geometry with the usual flux of each sub-aperture.
    """

    def __init__(self, camera_name: str, grid: SensorGeometry) -> None:
        self._camera_name, self._element_name = camera_name, grid.elements
        self._min_flux = DARK_FRACTION * grid.counts * grid.flux[grid.valid]
        self._dark_frames = 0

    def __call__(self, flux: NDArray[np.float32]) -> None:
        """Check the flux of every valid sub-aperture in one frame ``(n_valid,)``.

        Raises
        ------
        CalibrationError
            More than half of the sub-apertures were dark for :data:`DARK_FRAMES` consecutive frames.
        """
        is_dark = 2 * np.count_nonzero(flux > self._min_flux) < flux.size
        self._dark_frames = self._dark_frames + 1 if is_dark else 0
        if self._dark_frames >= DARK_FRAMES:
            raise CalibrationError(
                f"{self._camera_name}: no light on most {self._element_name} for {self._dark_frames} frames "
                "in a row; check the source, the beam stop and the exposure"
            )


def limit_to_reachable(
    dm: DeformableMirror, shape: NDArray[np.float64], now: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Shorten a command as a whole until the mirror accepts it at once.

    The shape is scaled to obey the stroke limits, and the step to it is shortened to obey the slew limit.
    What is sent then stays in the span of the modes that the shape and the present shape consist of. The
    guard would clip single actuators instead, and the rest would be taken for a response of the modes.

    ``shape``: command ``(n_act,)``; ``now``: shape from which the step is made, by default the present one.
    """
    now = dm.shape if now is None else now
    target = shape * dm.largest_legal_scale(shape)
    slew, furthest = dm.limits.max_slew, float(np.abs(target - now).max(initial=0.0))
    if slew is None or furthest <= slew:
        return target
    return np.asarray(now + (target - now) * (slew / furthest))


def ramp_to(dm: DeformableMirror, shape: NDArray[np.float64]) -> SendReport:
    """Send a shape, scaled to obey the limits, in as many commands as the slew limit requires.

    Returns the report of the last command; its ``sent`` is the shape of the mirror.
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
    """Next frame of the wavefront sensor, within the configured time-out."""
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
    """Build an interaction matrix of this bench with its provenance.

    ``bench``, ``grid``, ``m2c``: bench, sensor geometry and mode-to-command matrix ``(n_act, n_modes)``;
    ``data``, ``sigma``: matrix and its standard errors ``(n_slopes, n_modes)``.
    """
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
        bench.config.devices.dm.layout,
    )
