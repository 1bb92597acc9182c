"""Measuring the model PSF, so that a loop's Strehl ratio can be followed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.procedures.task import SavedRun

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


@dataclass(frozen=True, slots=True, eq=False)
class ModelPsf:
    """A model PSF ``(rows, columns)``, in counts."""

    model_psf: NDArray[np.float32]


class ModelPsfTask:
    """The model PSF, turbulence out of the beam meanwhile; see :class:`~escape_hw.runtime.procedures.task.Task`.

    Parameters
    ----------
    frames
        Science frames to average.
    """

    kind = "model-psf"
    overrides: tuple[str, ...] = ()

    def __init__(self, frames: int) -> None:
        self._frames = frames

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """It needs nothing."""

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[ModelPsf]:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.procedure`."""
        from escape_hw.runtime.procedures.calibration import model_psf

        return ModelPsf((yield from model_psf(bench, frames=self._frames)))

    def save(self, folder: RunFolder, record: BenchRecord, result: ModelPsf, wall_seconds: float) -> SavedRun:
        """Write down what was found; the image itself lies in the results of the loops judged by it."""
        image = result.model_psf
        document = {
            **record.header_fields("model-psf"),
            "title": f"Model PSF of {record.system}",
            "peak": float(image.max()),
            "total": float(image.sum(dtype=float)),
            "partial": False,
            "products": {},
            **record.footer_fields(wall_seconds),
        }
        folder.write_result(document)
        return SavedRun({**document, **folder.location_fields()})

    def finish(self) -> None:
        """Nothing was kept to go on with."""
