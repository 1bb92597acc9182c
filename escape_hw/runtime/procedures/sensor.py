"""Finding the sensor's geometry, so that slopes can be shown before anything is calibrated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.procedures.task import SavedRun

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.calibration.acquisition.sensor_setup import SensorSetup
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


class SensorTask:
    """Watch the sensor and find its geometry, mirror flat; see :class:`~escape_hw.runtime.procedures.task.Task`.

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
        """See :meth:`~escape_hw.runtime.procedures.task.Task.procedure`."""
        from escape_hw.calibration.acquisition.sensor_setup import find_sensor

        bench.dm.flatten()
        return find_sensor(bench, frames=self._frames)

    def save(
        self, folder: RunFolder, record: BenchRecord, result: SensorSetup, wall_seconds: float
    ) -> SavedRun:
        """Write down what was found."""
        grid = result.grid
        document = {
            **record.header_fields("sensor"),
            "title": f"Sensor of {record.system}",
            "n_sub_apertures": grid.n_valid,
            "counts": grid.counts,
            "background": grid.background,
            "partial": False,
            "products": {},
            **record.footer_fields(wall_seconds),
        }
        folder.write_result(document)
        return SavedRun({**document, **folder.location_fields()})

    def finish(self) -> None:
        """Nothing was kept to go on with."""
