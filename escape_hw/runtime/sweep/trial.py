"""One loop of a sweep, as a process of its own runs it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, run
from escape_hw.api.results import LoopResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.threads import share_cores
from escape_hw.bench import Bench
from escape_hw.calibration.closed_loop import closed_loop
from escape_hw.config.load import load_text
from escape_hw.config.models import SystemConfig
from escape_hw.errors import CalibrationError, IncompatibleProduct
from escape_hw.io.documents import strehl_document
from escape_hw.runtime.procedures import model_psf
from escape_hw.runtime.sweep.space import DELAY, overrides_of

#: A bench and what its twins share belong to one thread; a Dask worker may have several.
_turn = threading.Lock()


@dataclass(frozen=True, slots=True)
class Task:
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

    def configured(self) -> SystemConfig:
        """The configuration of this trial.

        Raises
        ------
        ConfigError
            A varied key does not exist, or a value is out of its range.
        """
        overrides = list(overrides_of(self.values))
        config = load_text(self.config, "sweep", overrides=overrides)
        if self.values.get(DELAY):
            latency = config.twin.latency_s + self.values[DELAY] / config.devices.wfs.frame_rate_hz
            overrides.append(f"twin.latency_s={latency!r}")
        if self.run_seed is not None:
            overrides.append(f"twin.run_seed={self.run_seed}")
        return load_text(self.config, "sweep", overrides=overrides)


def run_trial(task: Task) -> dict[str, Any]:
    """Open the twins, close the loop, and tell how it went.

    Returns
    -------
    dict
        Of plain values, see :func:`outcome`. A loop that cannot even be closed (a singular matrix, no
        light) counts as one that diverged, and ``notes`` say why.
    """
    share_cores()
    with _turn, Bench.from_config(task.configured()) as bench:
        try:
            return run(trial(bench, task))
        except CalibrationError as error:
            return {"strehl": None, "stable": False, "diverged": True, "notes": [str(error)]}


def trial(bench: Bench, task: Task) -> Procedure[dict[str, Any]]:
    """The loop on an open bench.

    Raises
    ------
    CalibrationError
        The matrix cannot be inverted, or the light has gone: on hardware a reason to stop.
    """
    matrix, grid = _matrix(task.matrix, task.sha256)
    if task.psf is None:
        psf = yield from model_psf(bench)
    else:
        psf = _psf(task.psf)
    values = task.values
    result = yield from closed_loop(
        bench, matrix, grid, gain=float(values["gain"]), leak=float(values["leak"]),
        dropped_modes=int(values["dropped_modes"]), frames=task.frames, model_psf=psf, stage="trial",
    )  # fmt: skip
    return outcome(result)


def outcome(result: LoopResult) -> dict[str, Any]:
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
def _matrix(path: str, sha256: str) -> tuple[InteractionMatrix, SensorGeometry]:
    from escape_hw.io.fits import load_matrix

    product = load_matrix(path)
    if product.sha256 != sha256:
        raise IncompatibleProduct(f"{path}: it is not the file any more that the sweep began with")
    return product.matrix, product.grid


@lru_cache(maxsize=4)
def _psf(path: str) -> NDArray[np.float32]:
    return np.asarray(np.load(Path(path), allow_pickle=False), np.float32)
