"""One loop of a sweep, as a process of its own runs it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import disable_helper_threads
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, run
from escape_hw.api.results import LoopResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import CalibrationError, IncompatibleProduct
from escape_hw.io.documents import strehl_document
from escape_hw.runtime.procedures.calibration import model_psf
from escape_hw.runtime.sweep.search_space import DELAY_KEY, config_overrides

#: A bench and what its twins share belong to one thread; a Dask worker may have several.
_bench_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """All that one loop needs, small enough to travel.

    Parameters
    ----------
    config
        The whole configuration, as TOML.
    matrix, sha256
        File of the matrix and its checksum.
    psf
        File of the model PSF (``.npy``); ``None``: the trial takes one of its own, because what it varies
        may change it.
    values
        The parameters by key.
    frames
        Length of the loop.
    run_seed
        Seed of air and noise on twins; ``None`` on hardware.
    """

    config: str
    matrix: str
    sha256: str
    psf: str | None
    values: dict[str, Any]
    frames: int
    run_seed: int | None

    def build_config(self) -> SystemConfig:
        """The configuration of this trial.

        Raises
        ------
        ConfigError
            A varied key does not exist, or a value is out of its range.
        """
        overrides = list(config_overrides(self.values))
        config = load_text(self.config, "sweep", overrides=overrides)
        if self.values.get(DELAY_KEY):
            latency = config.twin.latency_s + self.values[DELAY_KEY] / config.devices.wfs.frame_rate_hz
            overrides.append(f"twin.latency_s={latency!r}")
        if self.run_seed is not None:
            overrides.append(f"twin.run_seed={self.run_seed}")
        return load_text(self.config, "sweep", overrides=overrides)


def run_trial(task: TrialSpec) -> dict[str, Any]:
    """Open the twins, close the loop, and tell how it went.

    Returns
    -------
    dict
        Of plain values, see :func:`loop_outcome`. A loop that cannot even be closed (a singular matrix, no
        light) counts as one that diverged, and ``notes`` say why.
    """
    disable_helper_threads()
    with _bench_lock, Bench.from_config(task.build_config()) as bench:
        try:
            return run(run_closed_loop(bench, task))
        except CalibrationError as error:
            return {"strehl": None, "stable": False, "diverged": True, "notes": [str(error)]}


def run_closed_loop(bench: Bench, task: TrialSpec) -> Procedure[dict[str, Any]]:
    """The loop on an open bench.

    Raises
    ------
    CalibrationError
        The matrix cannot be inverted, or the light has gone: on hardware a reason to stop.
    """
    matrix, grid = _load_matrix(task.matrix, task.sha256)
    if task.psf is None:
        psf = yield from model_psf(bench)
    else:
        psf = _load_psf(task.psf)
    values = task.values
    result = yield from close_loop(
        bench, matrix, grid, gain=float(values["gain"]), leak=float(values["leak"]),
        dropped_modes=int(values["dropped_modes"]), frames=task.frames, model_psf=psf, stage="trial",
    )  # fmt: skip
    return loop_outcome(result)


def loop_outcome(result: LoopResult) -> dict[str, Any]:
    """What a sweep keeps of a loop, as plain values."""
    return {
        "strehl": strehl_document(result.strehl),
        "stable": bool(result.stable),
        "diverged": result.strehl is None,
        "frames": result.frames,
        "lost_frames": result.lost_frames,
        "residual_rms_nm": result.residual_rms_nm,
        "partial": result.partial,
        "notes": list(result.notes),
    }


@lru_cache(maxsize=16)
def _load_matrix(path: str, sha256: str) -> tuple[InteractionMatrix, SensorGeometry]:
    from escape_hw.io.fits.matrix import load_matrix

    product = load_matrix(path)
    if product.sha256 != sha256:
        raise IncompatibleProduct(f"{path}: it is not the file any more that the sweep began with")
    return product.matrix, product.grid


@lru_cache(maxsize=4)
def _load_psf(path: str) -> NDArray[np.float32]:
    return np.asarray(np.load(Path(path), allow_pickle=False), np.float32)
