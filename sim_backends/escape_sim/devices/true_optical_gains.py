"""True optical gains of the simulated sensor around recorded wavefronts; for tests and benchmarks only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.bench import Bench
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.devices.bench import SimBench

#: Poke of the push-pull in metres of optical path, rms; small enough for a linear response.
_POKE_M = 2e-9


def get_simulated_bench(bench: Bench) -> SimBench:
    """The simulated bench of a system; raises TypeError if its mirror is not simulated."""
    twin = getattr(bench.dm, "twin", None)
    if not isinstance(twin, SimBench):
        raise TypeError(f"{bench.dm.name} is not a simulated mirror; use a system in mode 'sim'")
    return twin


class WavefrontRecorder:
    """Records the wavefront at the sensor every ``every`` frames while something runs.

    ``recording`` may be set to False to pause; :meth:`close` ends the recording.
    """

    def __init__(self, twin: SimBench, every: int) -> None:
        self.wavefronts: list[NDArray[np.float32]] = []
        self._twin, self._every, self._n_frames, self.recording = twin, every, 0, True
        twin.path_callbacks.append(self)

    def __call__(self, opd: NDArray[np.float32], time_s: float) -> None:
        """Callback for the optical path ``(n, n)`` in metres of a frame."""
        self._n_frames += 1
        if self.recording and self._n_frames % self._every == 0:
            self.wavefronts.append(self._twin.sensor_opd(opd, time_s))

    def close(self) -> None:
        """Stop recording."""
        self._twin.path_callbacks.remove(self)


def true_responses(
    twin: SimBench,
    pupils: PyramidPupils,
    mode: NDArray[np.float64],
    wavefronts: Sequence[NDArray[np.float32]],
) -> NDArray[np.float64]:
    """Slopes per unit of a mode ``(n_act,)`` by noiseless push-pull around wavefronts, one row for each.

    Other parameters as for :func:`true_optical_gains`.
    """
    amplitude = _POKE_M / (2 * twin.config.devices.dm.stroke_m)
    shape, sensor = twin.mirror_opd(mode * amplitude), twin.sensor()
    changes = [
        slopes_of_image(sensor.frame(wavefront + shape), pupils)
        - slopes_of_image(sensor.frame(wavefront - shape), pupils)
        for wavefront in wavefronts
    ]
    return np.stack(changes) / (2 * amplitude)


def true_optical_gains(
    twin: SimBench,
    pupils: PyramidPupils,
    m2c: NDArray[np.float64],
    rows: NDArray[np.float64],
    wavefronts: Sequence[NDArray[np.float32]],
    modes: Sequence[int] | None = None,
) -> NDArray[np.float64]:
    """Optical gains by noiseless push-pull around fixed wavefronts.

    Parameters
    ----------
    twin
        The simulated bench.
    pupils
        Pupil images from which slopes are computed.
    m2c
        Modes ``(n_act, n_modes)``.
    rows
        Projection from slopes to gains ``(n_modes, n_slopes)``
        (:func:`~escape_hw.calibration.optical_gain.matrix_comparison.projector`).
    wavefronts
        Optical paths ``(n, n)`` in metres at the sensor.
    modes
        Selected modes; all by default.

    Returns
    -------
    ndarray, ``(n_wavefronts, n_modes)``
        NaN for modes not selected.
    """
    selected = range(m2c.shape[1]) if modes is None else modes
    gains = np.full((len(wavefronts), m2c.shape[1]), np.nan)
    for mode in selected:
        gains[:, mode] = true_responses(twin, pupils, m2c[:, mode], wavefronts) @ rows[mode]
    return gains
