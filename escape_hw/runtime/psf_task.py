"""Measuring the model PSF, so that a loop's Strehl ratio can be followed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.task import Kept

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


@dataclass(frozen=True, slots=True, eq=False)
class ModelPsf:
    """A model PSF ``(rows, columns)``, in counts."""

    model_psf: NDArray[np.float32]


class PsfTask:
    """The model PSF, turbulence out of the beam meanwhile; see :class:`~escape_hw.runtime.task.Task`.

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
        """See :meth:`~escape_hw.runtime.task.Task.procedure`."""
        from escape_hw.runtime.procedures import model_psf

        return ModelPsf((yield from model_psf(bench, frames=self._frames)))

    def keep(self, folder: RunFolder, record: BenchRecord, result: ModelPsf, wall_seconds: float) -> Kept:
        """Write down what was found; the image itself lies in the results of the loops judged by it."""
        image = result.model_psf
        document = {
            **record.head("model-psf"),
            "title": f"Model PSF of {record.system}",
            "peak": float(image.max()),
            "total": float(image.sum(dtype=float)),
            "partial": False,
            "products": {},
            **record.tail(wall_seconds),
        }
        folder.write_result(document)
        return Kept({**document, **folder.place()})

    def done(self) -> None:
        """Nothing was kept to go on with."""
