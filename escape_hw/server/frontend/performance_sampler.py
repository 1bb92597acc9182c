"""Seeing, registration and optical gains from the streams of an engine, in a thread of the front end."""

from __future__ import annotations

import logging
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, TO_STREAM_UNITS
from escape_hw.config.system import SystemConfig
from escape_hw.errors import EscapeError
from escape_hw.pipeline.seeing import fried_parameter, seeing_arcsec, turbulence_strength, used_modes
from escape_hw.remote.state import Phase, State
from escape_hw.streams.ring import ReaderCache, RingReader, Sample
from escape_hw.supervision import BackgroundThread

log = logging.getLogger(__name__)

#: Seconds between two looks at the streams, and frames that one look reads.
_PERIOD_S, _FRAMES = 0.2, 6
#: Pairs of frames in an estimate of the seeing: those of about ten seconds, and the fewest.
_MAX_PAIRS, _MIN_PAIRS = 200, 60
#: Least r0 for which a seeing is given, metres: the turbulence of a bench has none.
_MIN_SKY_R0_M = 0.01
#: Delay of a loop whose matrix has no temporal response, frames.
_DELAY_FRAMES = 2.0


class SeeingEstimator:
    """Strength of the turbulence from slopes, residuals and commands of a loop.

    In closed loop the modes are the residual minus the commands that the sensor sees; in open loop the
    reconstructor of the last matrix gives them from the slopes.

    Parameters
    ----------
    reconstructor
        ``(n_modes, n_slopes)``.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    delay_frames
        Frames from a command to the slopes that show it.
    radians_per_unit
        Wavefront of a mode at unit amplitude, radians rms.
    """

    def __init__(
        self,
        reconstructor: NDArray[np.floating],
        m2c: NDArray[np.floating],
        delay_frames: float,
        radians_per_unit: float,
    ) -> None:
        self.n_modes = m2c.shape[1]
        used = used_modes(self.n_modes)
        self.is_usable = used.stop > used.start
        self._reconstructor = (radians_per_unit * reconstructor[used]).astype(np.float32)
        self._to_modes = (radians_per_unit * np.linalg.pinv(m2c)[used]).astype(np.float32)
        self._delay = round(delay_frames)
        self._pairs: deque[NDArray[np.float32]] = deque(maxlen=_MAX_PAIRS)

    def clear(self) -> None:
        """Discard all frames."""
        self._pairs.clear()

    def add_closed(self, slopes: list[Sample], commands: list[Sample]) -> None:
        """Add successive frames of a closed loop; the command of a frame is written after its slopes."""
        known = [(one.arrived_ns, self._to_modes @ one.data) for one in commands]
        modes: dict[int, NDArray[np.float32]] = {}
        slopes = [one for one in slopes if one.data.size == self._reconstructor.shape[1]]
        for k, frame in enumerate(slopes):
            before = slopes[k - self._delay] if k >= self._delay else None
            if before is None or frame.index - before.index != self._delay:
                continue
            sent = next((command for at, command in known if at >= before.arrived_ns), None)
            if sent is not None:
                modes[frame.index] = self._reconstructor @ frame.data - sent
        self._pairs.extend(np.stack([modes[i], modes[i + 1]]) for i in modes if i + 1 in modes)

    def add_open(self, slopes: list[Sample]) -> None:
        """Add frames of an open loop with a flat mirror; they need not be successive, so noise counts."""
        for one in slopes:
            if one.data.size == self._reconstructor.shape[1]:
                modes = self._reconstructor @ one.data
                self._pairs.append(np.stack([modes, modes]))

    def strength(self) -> float | None:
        """Pupil diameters over r0; ``None`` with too few frames."""
        if len(self._pairs) < _MIN_PAIRS:
            return None
        return turbulence_strength(np.stack(self._pairs), self.n_modes) or None


class PerformanceSampler:
    """Reads the streams of the :attr:`state` that the front end sets, in a thread of its own."""

    def __init__(self, config: SystemConfig) -> None:
        self.state = State()
        self._config, self._readers = config, ReaderCache()
        self._is_orthonormal = config.basis.kind in ("kl", "zernike")
        self._estimator: SeeingEstimator | None = None
        self._loaded, self._mode = ("", 0), ""
        self._track_index = self._slopes_index = -1
        self._values: dict[str, float] = {}
        self._lock = threading.Lock()
        self._thread = BackgroundThread("performance", self._sample, _PERIOD_S, self._on_failure)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._thread.stop(timeout_s=2)
        self._readers.close()

    def take(self) -> dict[str, float]:
        """The values measured since the last call, by the names of a night's samples."""
        with self._lock:
            values, self._values = self._values, {}
        return values

    def _on_failure(self, error: Exception) -> None:
        log.error("the night log has no seeing and registration from now on: %s", error)

    def _reader(self, stream: str) -> RingReader | None:
        segment = {one.name: one.segment for one in self.state.streams}.get(stream)
        return self._readers.reader(stream, segment)

    def _sample(self) -> None:
        state = self.state
        values = self._tracked()
        mode = "" if state.phase not in (Phase.LOOP, Phase.IDLE) else state.phase.value
        estimator = self._seeing_estimator(state) if mode and self._is_orthonormal else None
        if estimator is not None:
            if mode != self._mode:
                estimator.clear()
            self._add_frames(estimator, closed=state.phase is Phase.LOOP)
            if (strength := estimator.strength()) is not None:
                system = self._config.system
                r0 = fried_parameter(strength, system.pupil_m, system.wavelength_m)
                values |= {"strength": strength, "r0_m": r0}
                if r0 > _MIN_SKY_R0_M:
                    values["seeing"] = seeing_arcsec(r0)
        self._mode = mode
        with self._lock:
            self._values |= values

    def _add_frames(self, estimator: SeeingEstimator, closed: bool) -> None:
        slopes, commands = self._reader("slopes"), self._reader("commands")
        if slopes is None or commands is None:
            return
        if closed:
            frames = _newest_entries(slopes, _FRAMES)
            estimator.add_closed(frames, _newest_entries(commands, _FRAMES + 1))
        elif (newest := slopes.latest(self._slopes_index)) is not None:
            self._slopes_index = newest.index
            estimator.add_open([newest])

    def _tracked(self) -> dict[str, float]:
        """Registration and optical gain of a tracker that runs."""
        if self.state.active_run is None:
            return {}
        values: dict[str, float] = {}
        track, gains = self._reader("registration_track"), self._reader("gains")
        sample = None if track is None else track.latest(self._track_index)
        if sample is not None and sample.data.ndim == 2 and len(sample.data):
            self._track_index = sample.index
            row = np.asarray(sample.data[-1, 1:], float) / np.tile(TO_STREAM_UNITS, 2)
            names = (*PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS))
            values = {name: float(one) for name, one in zip(names, row, strict=True) if np.isfinite(one)}
            newest: Any = None if gains is None else gains.latest()
            if newest is not None and np.isfinite(newest.data).any():
                values["optical_gain"] = float(np.nanmedian(newest.data))
        return values

    def _seeing_estimator(self, state: State) -> SeeingEstimator | None:
        """The estimator of the loop's matrix, read again when another matrix is in use."""
        product = next((one for one in state.products if one.name == state.loop.matrix), None)
        key = ("", 0) if product is None else (product.path, state.loop.dropped_modes)
        if key != self._loaded:
            self._loaded = key
            self._estimator = None if product is None else self._load(Path(key[0]), key[1])
        return self._estimator

    def _load(self, path: Path, dropped_modes: int) -> SeeingEstimator | None:
        # Imported here: the front end starts without them.
        from escape_hw.calibration.loop.control import invert_matrix
        from escape_hw.io.fits.matrix import load_matrix

        try:
            result = load_matrix(path).result
            inverse = invert_matrix(result.matrix, dropped_modes)
        except EscapeError as error:
            log.warning("no seeing with %s: %s", path, error)
            return None
        delay = _DELAY_FRAMES if result.response is None else result.response.delay_frames
        unit = 2 * self._config.devices.dm.stroke_m * 2 * np.pi / self._config.system.wavelength_m
        estimator = SeeingEstimator(inverse, result.matrix.m2c, delay, unit)
        return estimator if estimator.is_usable else None


def _newest_entries(reader: RingReader, count: int) -> list[Sample]:
    """The newest entries of a ring, the oldest first."""
    reader.seek(max(reader.position, reader.written - count))
    return [sample for _ in range(count) if (sample := reader.next()) is not None]
