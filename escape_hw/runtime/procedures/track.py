"""Following a drifting system, from the request to the kept track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.tracking import TrackResult
from escape_hw.bench import resolve_mode
from escape_hw.runtime.procedures.task import SavedRun, TaskWithMatrix, require_hardware_matrix, set_overrides

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.config.twin import TwinDrift
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord

#: Why a drifting twin's course stands nowhere.
INJECTED_UNKNOWN = (
    "the twin behind these drivers drifts by a clock of its own, so where its mirror sat is not known here"
)


class TrackTask(TaskWithMatrix):
    """The tracker; see :class:`~escape_hw.runtime.procedures.task.Task`.

    Parameters
    ----------
    im
        File of the matrix to begin with.
    seconds
        How long.
    poke, memory, gain
        Pokes, seconds in which old frames fade, gain of the loop; as configured by default.
    exchange
        False: only propose new matrices.
    strehl
        Measure the model PSF and follow the Strehl ratio.
    force
        Allow a simulated matrix on hardware.
    """

    kind = "track"

    def __init__(
        self,
        im: Path,
        *,
        seconds: float = 60.0,
        poke: float | None = None,
        memory: float | None = None,
        gain: float | None = None,
        exchange: bool = True,
        strehl: bool = True,
        force: bool = False,
    ) -> None:
        super().__init__(im, force=force)
        self.overrides = set_overrides(
            {"tracking.poke": poke, "tracking.memory_s": memory, "loop.gain": gain}
        )
        self._seconds, self._exchange, self._strehl = seconds, exchange, strehl

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[TrackResult]:
        """Model PSF where the bench can take one, then the tracker."""
        from escape_hw.calibration.tracking.tracker import track as track_procedure
        from escape_hw.runtime.procedures.calibration import model_psf

        product = self.product
        require_hardware_matrix(product, bench, self._force)
        psf = (yield from model_psf(bench)) if self._strehl and bench.science is not None else None
        return (
            yield from track_procedure(
                bench, product.matrix, product.grid, seconds=self._seconds,
                registration=product.registration, response=product.result.response,
                exchange=self._exchange, model_psf=psf,
            )
        )  # fmt: skip

    def save(
        self, folder: RunFolder, record: BenchRecord, result: TrackResult, wall_seconds: float
    ) -> SavedRun:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.save`."""
        from escape_hw.io.documents import track_document
        from escape_hw.runtime.procedures.products import add_calibration, write_run_result

        folder.add_product("table", folder.write_text("track.csv", result.to_csv()))
        if result.latest is not None:
            add_calibration(folder, record, "im", result.latest, {"im": self.product.path})
        track = track_document(result)
        injected = injected_registration(self.config) if record.simulated else None
        began, end = result.start_ns * 1e-9, result.rows["seconds"][-1:]
        document = write_run_result(
            folder,
            {
                **record.header_fields("track"),
                "title": f"Tracking {record.system}",
                **track,
                "injected_course": None
                if injected is None
                else injected.trajectory(began, track["track"]["seconds"]),
                # The truth where the track ends, beside its registration there.
                "injected_end": None
                if injected is None or not end
                else injected.at(began + end[0]).to_dict(),
                "injected_note": INJECTED_UNKNOWN if record.simulated and injected is None else "",
                "im": self.product.path.absolute(),
                "criteria": [
                    {"text": "loop stable", "met": result.stable},
                    {"text": f"no alarms ({len(result.alarms)})", "met": not result.alarms},
                ],
                **record.footer_fields(wall_seconds),
            },
        )
        return SavedRun(document, result.stable and not result.alarms)


@dataclass(frozen=True, slots=True)
class InjectedRegistration:
    """Where a twin's mirror really sits; for reports only.

    Parameters
    ----------
    start
        At time zero of the twin's clock.
    drift
        How it moves on.
    """

    start: Registration
    drift: TwinDrift

    def at(self, seconds: float) -> Registration:
        """At a time of the twin's clock."""
        moved = Registration.from_array(self.start.to_array() + self.drift.offsets_at(seconds))
        return replace(moved, anamorphosis_angle=self.start.anamorphosis_angle)

    def trajectory(self, began: float, seconds: Sequence[float]) -> dict[str, list[float]]:
        """Every parameter, scalings along x and y, some seconds after a time of the twin's clock."""
        moved = np.array([self.at(began + t).axis_scalings_and_shear[0].to_array() for t in seconds])
        return {
            name: column.tolist() for name, column in zip(PARAMETERS, moved.reshape(-1, 5).T, strict=True)
        }


def injected_registration(config: SystemConfig) -> InjectedRegistration | None:
    """Where the mirror of a simulated system sits; ``None`` where that cannot be known.

    Behind real drivers the twin runs on a clock that no driver tells: frames have the computer's time.
    Where nothing moves, no clock is needed.
    """
    drift = config.twin.drift
    if drift.is_drifting and resolve_mode(config.devices.wfs, config) != "sim":
        return None
    return InjectedRegistration(config.twin.registration.to_registration(), drift)
