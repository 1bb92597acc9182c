"""Measurement of the model PSF, the reference of Strehl ratios."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun, parameter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord

#: Science frames that are averaged for a model PSF.
MODEL_PSF_FRAMES = 20


def model_psf(bench: Bench, *, frames: int = MODEL_PSF_FRAMES) -> Procedure[NDArray[np.float32]]:
    """Measure the model PSF, the reference of Strehl ratios, with the phase screen out of the beam.

    Raises
    ------
    CalibrationError
        The system has no science camera.
    """
    from escape_hw.calibration.acquisition.model_psf import measure_model_psf
    from escape_hw.runtime.session.record import without_turbulence

    with without_turbulence(bench):
        return (yield from measure_model_psf(bench, frames=frames))


@dataclass(frozen=True, slots=True, eq=False)
class ModelPsf:
    """A model PSF ``(rows, columns)``, in counts."""

    model_psf: NDArray[np.float32]


class ModelPsfProcedure(ProcedureSpec[ModelPsf]):
    """The PSF of the flat mirror without turbulence; needs a science camera."""

    name = "model-psf"
    title = "Model PSF"
    help = "Measure the PSF of the flat mirror without turbulence, the reference of Strehl ratios."

    frames: int = parameter(
        default=MODEL_PSF_FRAMES, help="Science frames to average.", unit="frame", low=1, high=1e8
    )

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames that pass while the science camera takes its frames."""
        frames = int(arguments.get("frames") or 0)
        if bench.science is None:
            return frames
        ratio = bench.wfs.settings.frame_rate_hz / bench.science.settings.frame_rate_hz
        return math.ceil(frames * ratio)

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[ModelPsf]:
        """Average science frames, the phase screen out of the beam."""
        return ModelPsf((yield from model_psf(bench, frames=self.frames)))

    def save(self, folder: RunFolder, record: BenchRecord, result: ModelPsf, wall_seconds: float) -> SavedRun:
        """Save peak and total; the image itself is saved with each loop that is compared with it."""
        from escape_hw.runtime.procedures.products import save_values

        image = result.model_psf
        values = {"peak": float(image.max()), "total": float(image.sum(dtype=float))}
        title = f"Model PSF of {record.system}"
        return save_values(folder, record, self.name, title, values, wall_seconds)
