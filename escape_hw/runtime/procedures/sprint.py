"""SPRINT on a matrix that was kept, from the request to the kept registration; nothing moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.runtime.procedures.task import SavedRun, TaskWithMatrix, set_overrides

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.api.synthetic_model import SyntheticModel
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


class SprintTask(TaskWithMatrix):
    """The registration behind a measured matrix; see :class:`~escape_hw.runtime.procedures.task.Task`.

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
        self.overrides = set_overrides(
            {f"calibration.{key}": value for key, value in (settings or {}).items()}
        )

    def _load_matrix(self, config: SystemConfig, simulated: bool) -> MatrixProduct:
        # Nothing moves: a matrix of other modes than the configured ones is as good.
        from escape_hw.io.fits.matrix import load_matrix

        return load_matrix(
            self._im,
            expect_system=config.system.name,
            expect_sensor=config.sensor.kind,
            expect_actuators=config.devices.dm.n_act,
        )

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[CalibrationResult]:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.procedure`; the bench is not touched."""
        return self.fit()

    def fit(self) -> Procedure[CalibrationResult]:
        """Find the registration; the result's matrix is the measured one."""
        from escape_hw.calibration.sprint.fit import estimate_registration, sprint_options_from_config

        settings, product = self.config.calibration, self.product
        measured = product.result.measured or product.matrix
        yield Reporter("synthetic model", 1, "model")(0)
        estimate = yield from estimate_registration(
            measured,
            self._synthetic_model(),
            modes=min(settings.sprint_modes, measured.n_modes),
            **sprint_options_from_config(settings),
        )
        return replace(product.result, matrix=measured, measured=None, registration=estimate)

    def _synthetic_model(self) -> SyntheticModel:
        """The model that is inverted; a pyramid's takes seconds to make."""
        from escape_hw.config.registry import model_factory

        if self._model is None:
            self._model = model_factory(self.config.calibration.model)(self.config, self.product.grid)
        return self._model

    def save(
        self, folder: RunFolder, record: BenchRecord, result: CalibrationResult, wall_seconds: float
    ) -> SavedRun:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.save`; the bench of the day has nothing to do with it."""
        return self.save_fit(folder, result, wall_seconds)

    def save_fit(self, folder: RunFolder, result: CalibrationResult, wall_seconds: float) -> SavedRun:
        """Save the matrix with its registration, and the matrix of the model there.

        Raises
        ------
        StorageError
            They cannot be written.
        """
        from escape_hw.calibration.sprint.synthetic_matrix import synthesise_from_measurement
        from escape_hw.io import documents
        from escape_hw.io.fits.matrix import save_matrix
        from escape_hw.io.provenance import format_utc
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import write_run_result
        from escape_hw.runtime.session.record import config_provenance

        estimate, measured, name = result.registration, result.matrix, self.product.path.name
        if estimate is None:
            raise RuntimeError("a fit without a registration")
        origin = replace(config_provenance(self.config), parents={name: self.product.sha256})
        folder.add_product("im", save_matrix(folder.file("im.fits"), result, origin))
        synthetic = synthesise_from_measurement(result, self._synthetic_model(), estimate)
        folder.add_product("escape", save_matrix(folder.file("escape.fits"), synthetic, origin))
        document = write_run_result(
            folder,
            {
                **documents.header_fields(
                    "sprint", measured.system, measured.simulated, self.config.system.seed
                ),
                "title": f"Registration of {measured.system}",
                **documents.calibration_document(result),
                "criteria": [criteria.sprint_converged(name, estimate)],
                "labels": {"im": {"column": ""}, "escape": {"column": ""}},
                "finished_utc": format_utc(),
                "wall_seconds": wall_seconds,
            },
        )
        return SavedRun(document, estimate.converged)
