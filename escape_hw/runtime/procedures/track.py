"""Tracking of a drifting system in closed loop."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from escape_hw.runtime.procedures.declaration import SavedRun, parameter
from escape_hw.runtime.procedures.matrix_input import MatrixProcedure, require_hardware_matrix

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.registration import Registration
    from escape_hw.api.tracking import TrackResult
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.config.twin import TwinDrift
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord

#: Reason why a report does not show the injected registration of a drifting twin.
INJECTED_UNKNOWN = (
    "the twin behind these drivers drifts with a clock of its own, so its true registration is not known"
)


class TrackProcedure(MatrixProcedure["TrackResult"]):
    """The tracker: a closed loop with small pokes, from which drifts are estimated."""

    name = "track"
    title = "Tracker"
    help = "Close the loop and follow drifts of registration, optical gains and interaction matrix."
    random_pokes = True

    seconds: float = parameter(default=60.0, help="Duration.", unit="s", low=1, high=1e6)
    poke: float | None = parameter(
        default=None, help="Pokes of each mode, rms surface as fraction of full stroke.",
        unit="of full stroke", low=1e-6, high=1, config_key="tracking.poke", sets_config=True,
    )  # fmt: skip
    forgetting_time_s: float | None = parameter(
        default=None, help="Time in which the weight of a frame falls to 1/e.", unit="s", low=1, high=1e5,
        config_key="tracking.forgetting_time_s", sets_config=True, deprecated=("memory", "memory_s"),
        label="Forgetting time",
    )  # fmt: skip
    gain: float | None = parameter(
        default=None, help="Gain of the integrator.", low=0.001, high=2, config_key="loop.gain",
        sets_config=True,
    )  # fmt: skip
    exchange: bool = parameter(
        default=True, help="Exchange the matrix in use for a better one; otherwise only propose new ones.",
        label="Exchange matrix", deprecated_inverse=("propose",),
    )  # fmt: skip

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames of the model PSF and of the given duration."""
        duration = math.ceil(float(arguments.get("seconds") or 0.0) * bench.wfs.settings.frame_rate_hz)
        return cls.preparation_frames(bench, arguments) + duration

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read the matrix."""
        super().load(config, simulated)
        self._config = config

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[TrackResult]:
        """Measure the model PSF, then close the loop and track."""
        from escape_hw.calibration.tracking.tracker import track as track_procedure

        product = self.product
        require_hardware_matrix(product, bench, self.force)
        psf = yield from self.take_model_psf(bench)
        return (
            yield from track_procedure(
                bench, product.matrix, product.grid, seconds=self.seconds,
                registration=product.registration, response=product.result.response,
                exchange=self.exchange, model_psf=psf,
            )
        )  # fmt: skip

    def save(
        self, folder: RunFolder, record: BenchRecord, result: TrackResult, wall_seconds: float
    ) -> SavedRun:
        """Save the time series, the last matrix and the report."""
        from escape_hw.io.documents import track_document
        from escape_hw.runtime.procedures.products import add_result, save_run

        folder.add_product("table", folder.write_text("track.csv", result.to_csv()))
        if result.latest is not None:
            add_result(folder, record, "im", result.latest, self.product.path)
        track = track_document(result)
        injected = injected_registration(self._config) if record.applies_twin_section else None
        began, end = result.start_ns * 1e-9, result.rows["seconds"][-1:]
        document = save_run(
            folder, record, "track", f"Tracking {record.system}", wall_seconds,
            **track,
            injected_course=None
            if injected is None
            else injected.trajectory(began, track["track"]["seconds"]),
            # True values at the end of the track, for comparison with its last registration.
            injected_end=None if injected is None or not end else injected.at(began + end[0]).to_dict(),
            injected_note=INJECTED_UNKNOWN if record.applies_twin_section and injected is None else "",
            im=self.product.path.absolute(),
            criteria=[
                {"text": "loop stable", "met": result.stable},
                {"text": f"no alarms ({len(result.alarms)})", "met": not result.alarms},
            ],
        )  # fmt: skip
        return SavedRun(document, result.stable and not result.alarms)


@dataclass(frozen=True, slots=True)
class InjectedRegistration:
    """Injected registration of a twin over time, from its start by the drift; for reports only."""

    start: Registration
    drift: TwinDrift

    def at(self, seconds: float) -> Registration:
        """Registration at a time of the twin's clock."""
        from escape_hw.api.registration import Registration

        moved = Registration.from_array(self.start.to_array() + self.drift.offsets_at(seconds))
        return replace(moved, anamorphosis_angle=self.start.anamorphosis_angle)

    def trajectory(self, began: float, seconds: Sequence[float]) -> dict[str, list[float]]:
        """Parameters by name, scalings along x and y, ``seconds`` after ``began`` on the twin's clock."""
        import numpy as np

        from escape_hw.api.registration import PARAMETERS

        moved = np.array([self.at(began + t).axis_scalings_and_shear[0].to_array() for t in seconds])
        return {
            name: column.tolist() for name, column in zip(PARAMETERS, moved.reshape(-1, 5).T, strict=True)
        }


def injected_registration(config: SystemConfig) -> InjectedRegistration | None:
    """Injected registration of a simulated system; ``None`` if it is not known.

    It is not known for a drifting twin behind real drivers: frames then carry the computer's time, and no
    driver reports the clock of the twin.
    """
    from escape_hw.bench import resolve_mode

    drift = config.twin.drift
    if drift.is_drifting and resolve_mode(config.devices.wfs, config) != "sim":
        return None
    return InjectedRegistration(config.twin.registration.to_registration(), drift)
