"""Following a drifting system, from the request to the kept track."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.tracking import TrackResult
from escape_hw.runtime.matrix_task import MatrixTask
from escape_hw.runtime.task import Kept, given, refuse_simulated

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


class TrackTask(MatrixTask):
    """The tracker; see :class:`~escape_hw.runtime.task.Task`.

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
        self.overrides = given({"tracking.poke": poke, "tracking.memory_s": memory, "loop.gain": gain})
        self._seconds, self._exchange, self._strehl = seconds, exchange, strehl

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[TrackResult]:
        """Model PSF where the bench can take one, then the tracker."""
        from escape_hw.calibration.track import track as follow
        from escape_hw.runtime.procedures import model_psf

        product = self.product
        refuse_simulated(product, bench, self._force)
        psf = (yield from model_psf(bench)) if self._strehl and bench.science is not None else None
        return (
            yield from follow(
                bench, product.matrix, product.grid, seconds=self._seconds,
                registration=product.registration, response=product.result.response,
                exchange=self._exchange, model_psf=psf,
            )
        )  # fmt: skip

    def keep(self, folder: RunFolder, record: BenchRecord, result: TrackResult, wall_seconds: float) -> Kept:
        """See :meth:`~escape_hw.runtime.task.Task.keep`."""
        from escape_hw.io.track_document import track_document
        from escape_hw.runtime.keep import finish, keep_calibration

        folder.add("table", folder.write_text("track.csv", result.to_csv()))
        if result.latest is not None:
            keep_calibration(folder, record, "im", result.latest, {"im": self.product.path})
        track = track_document(result)
        document = finish(
            folder,
            {
                **record.head("track"),
                "title": f"Tracking {record.system}",
                **track,
                "planted_course": self._planted(result, track["track"]["seconds"])
                if record.simulated
                else None,
                "im": self.product.path.absolute(),
                "criteria": [
                    {"text": "loop stable", "met": result.stable},
                    {"text": f"no alarms ({len(result.alarms)})", "met": not result.alarms},
                ],
                **record.tail(wall_seconds),
            },
        )
        return Kept(document, result.stable and not result.alarms)

    def _planted(self, result: TrackResult, seconds: list[float]) -> dict[str, list[float]] | None:
        """True registration of the twin at some moments of the track; for reports only."""
        twin = self.config.twin
        if twin is None:
            return None
        start = twin.registration.to_registration().to_array()
        course = [start + twin.drift.way(result.began_ns * 1e-9 + t) for t in seconds]
        return {name: [float(there[k]) for there in course] for k, name in enumerate(PARAMETERS)}
