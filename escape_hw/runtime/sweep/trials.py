"""One closed loop of a sweep, in a worker process or on an open bench."""

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
from escape_hw.runtime.procedures.model_psf import model_psf
from escape_hw.runtime.sweep.design import Slot, Sweep
from escape_hw.runtime.sweep.search_space import DELAY_KEY, config_overrides

#: A bench and what its simulated devices share belong to one thread; a Dask worker may have several.
_bench_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class TrialSpec:
    """Everything that a worker needs for one loop.

    ``config`` is the whole configuration as TOML, ``matrix`` and ``sha256`` file and checksum of the matrix,
    ``psf`` the file of the model PSF (``.npy``; ``None``: the trial computes its own, because a parameter may
    change it), ``run_seed`` the seed of turbulence and noise in simulation (``None`` on hardware).
    """

    config: str
    matrix: str
    sha256: str
    psf: str | None
    values: dict[str, Any]
    frames: int
    run_seed: int | None

    @classmethod
    def from_slot(cls, sweep: Sweep, slot: Slot, values: dict[str, Any]) -> TrialSpec:
        """The loop of a slot."""
        variant = next(one for one in sweep.variants if one.label == slot.variant)
        seed = slot.run_seed(sweep.seed) if sweep.simulated else None
        path, sha256 = str(variant.path), variant.sha256
        return cls(sweep.config, path, sha256, sweep.psf, values, sweep.frames, seed)

    def build_config(self) -> SystemConfig:
        """The configuration of this trial.

        Raises
        ------
        ConfigError
            A varied key does not exist, or a value is out of its range.
        """
        overrides = list(config_overrides(self.values))
        if self.values.get(DELAY_KEY):
            config = load_text(self.config, "sweep", overrides=overrides)
            latency = config.twin.latency_s + self.values[DELAY_KEY] / config.devices.wfs.frame_rate_hz
            overrides.append(f"twin.latency_s={latency!r}")
        if self.run_seed is not None:
            overrides.append(f"twin.run_seed={self.run_seed}")
        return load_text(self.config, "sweep", overrides=overrides)


def run_trial(spec: TrialSpec) -> dict[str, Any]:
    """Open the simulated bench and close the loop; see :func:`loop_outcome`.

    A loop that cannot be closed (singular matrix, no light) counts as diverged; ``notes`` hold the reason.
    """
    disable_helper_threads()
    with _bench_lock, Bench.from_config(spec.build_config()) as bench:
        try:
            return run(run_closed_loop(bench, spec))
        except CalibrationError as error:
            return {"strehl": None, "stable": False, "diverged": True, "notes": [str(error)]}


def run_closed_loop(bench: Bench, spec: TrialSpec) -> Procedure[dict[str, Any]]:
    """Close the loop of a trial on an open bench; see :func:`loop_outcome`.

    Raises
    ------
    CalibrationError
        The matrix cannot be inverted, or the light was lost.
    """
    matrix, grid = _load_matrix(spec.matrix, spec.sha256)
    psf = (yield from model_psf(bench)) if spec.psf is None else _load_psf(spec.psf)
    values = spec.values
    result = yield from close_loop(
        bench, matrix, grid, gain=float(values["gain"]), leak=float(values["leak"]),
        dropped_modes=int(values["dropped_modes"]), frames=spec.frames, model_psf=psf, stage="trial",
    )  # fmt: skip
    return loop_outcome(result)


def loop_outcome(result: LoopResult) -> dict[str, Any]:
    """The part of a loop's result that is stored in the study, as JSON values."""
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
        raise IncompatibleProduct(f"{path}: changed since the sweep began")
    return product.matrix, product.grid


@lru_cache(maxsize=4)
def _load_psf(path: str) -> NDArray[np.float32]:
    return np.asarray(np.load(Path(path), allow_pickle=False), np.float32)
