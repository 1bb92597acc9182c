"""SPRINT on a matrix that was kept, from the request to the kept registration; nothing moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.runtime.matrix_task import MatrixTask
from escape_hw.runtime.task import Kept, given

if TYPE_CHECKING:
    from escape_hw.api.model import SyntheticModel
    from escape_hw.api.results import CalibrationResult
    from escape_hw.bench import Bench
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


class SprintTask(MatrixTask):
    """The registration behind a measured matrix; see :class:`~escape_hw.runtime.task.Task`.

    Parameters
    ----------
    im
        File of the matrix; where it is a pseudo-synthetic one, the measured one behind it counts.
    settings
        Keys of the configuration's section ``calibration`` to change; ``None``: as configured.
    """

    kind = "sprint"

    def __init__(self, im: Path, settings: dict[str, object] | None = None) -> None:
        super().__init__(im)
        self._model: SyntheticModel | None = None
        self.overrides = given({f"calibration.{key}": value for key, value in (settings or {}).items()})

    def _read(self, config: SystemConfig, simulated: bool) -> MatrixProduct:
        # Nothing moves: a matrix of other modes than the configured ones is as good.
        from escape_hw.io.fits import load_matrix

        return load_matrix(
            self._im,
            expect_system=config.system.name,
            expect_sensor=config.sensor.kind,
            expect_actuators=config.devices.dm.n_act,
        )

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[CalibrationResult]:
        """See :meth:`~escape_hw.runtime.task.Task.procedure`; the bench is not touched."""
        return self.fit()

    def fit(self) -> Procedure[CalibrationResult]:
        """Find the registration; the result's matrix is the measured one."""
        from escape_hw.calibration.sprint import sprint_steps
        from escape_hw.calibration.sprint_settings import as_configured

        settings, product = self.config.calibration, self.product
        measured = product.result.measured or product.matrix
        yield Reporter("synthetic model", 1, "model")(0)
        estimate = yield from sprint_steps(
            measured,
            self._synthetic(),
            modes=min(settings.sprint_modes, measured.n_modes),
            **as_configured(settings),
        )
        return replace(product.result, matrix=measured, measured=None, registration=estimate)

    def _synthetic(self) -> SyntheticModel:
        """The model that is inverted; a pyramid's takes seconds to make."""
        from escape_hw.config.registry import model_factory

        if self._model is None:
            self._model = model_factory(self.config.calibration.model)(self.config, self.product.grid)
        return self._model

    def keep(
        self, folder: RunFolder, record: BenchRecord, result: CalibrationResult, wall_seconds: float
    ) -> Kept:
        """See :meth:`~escape_hw.runtime.task.Task.keep`; the bench of the day has nothing to do with it."""
        return self.save(folder, result, wall_seconds)

    def save(self, folder: RunFolder, result: CalibrationResult, wall_seconds: float) -> Kept:
        """Save the matrix with its registration, and the matrix of the model there.

        Raises
        ------
        StorageError
            They cannot be written.
        """
        from escape_hw.calibration.pseudo_synthetic import synthetic_of
        from escape_hw.io import documents
        from escape_hw.io.fits import save_matrix
        from escape_hw.io.provenance import utc_text
        from escape_hw.runtime import criteria
        from escape_hw.runtime.keep import finish
        from escape_hw.runtime.records import config_record

        estimate, measured, name = result.registration, result.matrix, self.product.path.name
        if estimate is None:
            raise RuntimeError("a fit without a registration")
        origin = replace(config_record(self.config), parents={name: self.product.sha256})
        folder.add("im", save_matrix(folder.file("im.fits"), result, origin))
        synthetic = synthetic_of(result, self._synthetic(), estimate)
        folder.add("escape", save_matrix(folder.file("escape.fits"), synthetic, origin))
        document = finish(
            folder,
            {
                **documents.head("sprint", measured.system, measured.simulated, self.config.system.seed),
                "title": f"Registration of {measured.system}",
                **documents.calibration_document(result),
                "criteria": [criteria.converged(name, estimate)],
                "labels": {"im": {"column": ""}, "escape": {"column": ""}},
                "finished_utc": utc_text(),
                "wall_seconds": wall_seconds,
            },
        )
        return Kept(document, estimate.converged)
