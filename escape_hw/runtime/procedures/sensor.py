"""Detection of the sensor's geometry, so that slopes can be shown before anything is calibrated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun, parameter

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.calibration.acquisition.sensor_setup import SensorSetup
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


class SensorProcedure(ProcedureSpec["SensorSetup"]):
    """The geometry of the sensor, found on frames with the mirror flat."""

    name = "sensor"
    title = "Find the sensor"
    help = "Find the sub-apertures or pupil images on the sensor; the mirror stays flat."

    frames: int = parameter(
        default=200, help="Frames to average; turbulence needs more.", unit="frame", low=1, high=1e8
    )

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[SensorSetup]:
        """Flatten the mirror and find the geometry."""
        from escape_hw.calibration.acquisition.sensor_setup import find_sensor

        bench.dm.flatten()
        return find_sensor(bench, frames=self.frames)

    def save(
        self, folder: RunFolder, record: BenchRecord, result: SensorSetup, wall_seconds: float
    ) -> SavedRun:
        """Save the number of sub-apertures, the counts and the background."""
        from escape_hw.runtime.procedures.products import save_values

        grid = result.grid
        title = f"Sensor of {record.system}"
        values = {"n_sub_apertures": grid.n_valid, "counts": grid.counts, "background": grid.background}
        return save_values(folder, record, self.name, title, values, wall_seconds)
