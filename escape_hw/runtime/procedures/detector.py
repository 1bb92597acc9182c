"""Dark frame and flat of the wavefront sensor's camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from escape_hw.errors import ConfigError
from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun, parameter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


@dataclass(frozen=True, slots=True, eq=False)
class PixelCalibration:
    """A dark frame in counts, or the relative response of the pixels ``(rows, columns)``."""

    image: NDArray[np.float32]


class _PixelProcedure(ProcedureSpec[PixelCalibration]):
    """A mean frame that calibrates the pixels."""

    def save(
        self, folder: RunFolder, record: BenchRecord, result: PixelCalibration, wall_seconds: float
    ) -> SavedRun:
        """Save the image as FITS, and its mean and scatter."""
        from escape_hw.io.fits.pixels import save_pixels
        from escape_hw.runtime.procedures.products import save_values

        image, path = result.image, folder.file(f"{self.name}.fits")
        save_pixels(
            path,
            "DARK" if self.name == "dark" else "FLAT",
            image,
            record.system,
            record.simulated,
            record.origin(),
        )
        folder.add_product(self.name, path)
        values = {"mean": float(image.mean()), "scatter": float(image.std())}
        return save_values(
            folder, record, self.name, f"{self.title} of {record.system}", values, wall_seconds
        )


class DarkProcedure(_PixelProcedure):
    """The mean frame of the sensor's camera without light; the slopes use it from then on."""

    name = "dark"
    title = "Dark frame"
    help = "Measure the dark frame of the sensor's camera with the beam blocked."

    frames: int = parameter(default=100, help="Frames to average.", unit="frame", low=1, high=1e6)
    blocked_by_hand: bool = parameter(
        default=False, help="The beam is blocked already, where there is no beam stop under remote control."
    )

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[PixelCalibration]:
        """Average frames, the beam stop in the beam."""
        from escape_hw.calibration.acquisition.sensor_setup import measure_dark

        bench.dm.flatten()
        dark = yield from measure_dark(bench, frames=self.frames, blocked_by_hand=self.blocked_by_hand)
        return PixelCalibration(dark)


class FlatProcedure(_PixelProcedure):
    """The relative response of the pixels of the sensor's camera; the slopes use it from then on."""

    name = "flat"
    title = "Flat"
    help = "Measure the relative response of the pixels in uniform light, after the dark frame."

    frames: int = parameter(default=100, help="Frames to average.", unit="frame", low=1, high=1e6)

    def require_first(self, config: SystemConfig) -> None:
        """Refuse a configuration without a dark frame."""
        if not config.devices.wfs.dark_file:
            raise ConfigError(
                f"'{config.system.name}' has no dark frame, which a flat needs: measure it with 'escape "
                "dark', and name its dark.fits in devices.wfs.dark_file"
            )

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[PixelCalibration]:
        """Average frames in uniform light."""
        from escape_hw.calibration.acquisition.sensor_setup import measure_flat

        bench.dm.flatten()
        return PixelCalibration((yield from measure_flat(bench, frames=self.frames)))
