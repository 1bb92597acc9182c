"""Finding the sensor's geometry, so that slopes can be shown before anything is calibrated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.task import Kept

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.calibration.sensor_setup import SensorSetup
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


class SensorTask:
    """Watch the sensor and find its geometry, mirror flat; see :class:`~escape_hw.runtime.task.Task`.

    Parameters
    ----------
    frames
        Frames to average.
    """

    kind = "sensor"
    overrides: tuple[str, ...] = ()

    def __init__(self, frames: int) -> None:
        self._frames = frames

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """It needs nothing."""

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[SensorSetup]:
        """See :meth:`~escape_hw.runtime.task.Task.procedure`."""
        from escape_hw.calibration.sensor_setup import find_sensor

        bench.dm.flatten()
        return find_sensor(bench, frames=self._frames)

    def keep(self, folder: RunFolder, record: BenchRecord, result: SensorSetup, wall_seconds: float) -> Kept:
        """Write down what was found."""
        grid = result.grid
        document = {
            **record.head("sensor"),
            "title": f"Sensor of {record.system}",
            "n_sub_apertures": grid.n_valid,
            "counts": grid.counts,
            "background": grid.background,
            "partial": False,
            "products": {},
            **record.tail(wall_seconds),
        }
        folder.write_result(document)
        return Kept({**document, **folder.place()})

    def done(self) -> None:
        """Nothing was kept to go on with."""
