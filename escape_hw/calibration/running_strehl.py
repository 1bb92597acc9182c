"""The Strehl ratio of a loop that runs, over its last frames."""

from __future__ import annotations

import logging
import math
from concurrent.futures import Executor, Future

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import Measured
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.standard_error import LEAST
from escape_hw.pipeline.strehl import strehl

log = logging.getLogger(__name__)


class RunningStrehl:
    """Judges the science frames since the last time, in another thread.

    Parameters
    ----------
    model
        PSF without turbulence ``(rows, columns)``.
    """

    def __init__(self, model: NDArray[np.float32]) -> None:
        self._model = model
        self._pending: Future[Measured | None] | None = None
        self._value = Measured(math.nan, math.nan)

    def take(self, images: FrameStack, pool: Executor) -> bool:
        """Judge these images, if they are enough and the last ones are judged; whether they were taken."""
        if self._pending is not None:
            if not self._pending.done():
                return False
            self._value, self._pending = self._pending.result() or self._value, None
        if images.count < LEAST:
            return False
        self._pending = pool.submit(self._judge, images)
        return True

    def metrics(self) -> dict[str, float]:
        """The latest ratio by its peak, and its standard error; NaN before the first."""
        return {"strehl": self._value.value, "strehl_sigma": self._value.sigma}

    def _judge(self, images: FrameStack) -> Measured | None:
        try:
            return strehl(images.images(), self._model).peak
        except CalibrationError as error:
            log.warning("no Strehl ratio: %s", error)
            return None
