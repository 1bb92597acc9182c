"""SPRINT on a saved interaction matrix; no device moves."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from escape_hw.config.choices import EXTRA_PARAMETERS, LOSSES, MODES_CHOICES, SOLVERS
from escape_hw.runtime.procedures.declaration import ComputedProcedure, ProcedureSpec, SavedRun, parameter
from escape_hw.runtime.procedures.matrix_input import load_matrix_of_mirror

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import CalibrationResult
    from escape_hw.api.synthetic_model import SyntheticModel
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder

ResultT = TypeVar("ResultT")


class SprintParameters(ProcedureSpec[ResultT]):
    """Parameters of the procedures that run SPRINT."""

    solver: str | None = parameter(
        default=None, help="Solver of SPRINT.", choices=SOLVERS, config_key="calibration.solver",
        sets_config=True, last=True,
    )  # fmt: skip
    modes_choice: str | None = parameter(
        default=None, help="Criterion by which SPRINT chooses its modes.", choices=MODES_CHOICES,
        config_key="calibration.modes_choice", sets_config=True, last=True,
    )  # fmt: skip
    loss: str | None = parameter(
        default=None, help="Loss function of SPRINT; huber tolerates bad sub-apertures.", choices=LOSSES,
        config_key="calibration.loss", sets_config=True, last=True,
    )  # fmt: skip
    extra_parameters: str | None = parameter(
        default=None,
        help="What SPRINT fits beside the registration, separated by commas.",
        config_key="calibration.extra_parameters", kind="choices", choices=EXTRA_PARAMETERS,
        sets_config=True, last=True, deprecated=("also",),
    )  # fmt: skip


class SprintProcedure(ComputedProcedure["CalibrationResult"], SprintParameters["CalibrationResult"]):
    """The registration behind a measured matrix, and the matrix of the model there."""

    name = "sprint"
    title = "SPRINT"
    help = "Estimate the registration behind a measured matrix, and compute the synthetic matrix for it."

    im: Path = parameter(
        help="Measured interaction matrix, or a pseudo-synthetic one with the measured matrix behind it.",
        label="Matrix", kind="matrix",
    )  # fmt: skip

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read the matrix; number of modes, basis and mode may differ from the configuration."""
        from escape_hw.io.fits.file import expect

        self._config = config
        self._product = product = load_matrix_of_mirror(self.im, config)
        wanted = (config.sensor.n_sub, config.sensor.n_sub)
        expect(product.path, "grid of sub-apertures", product.matrix.valid.shape, wanted)

    def compute(self) -> Procedure[CalibrationResult]:
        """Estimate the registration; the matrix of the result is the measured one."""
        from escape_hw.api.procedure import Reporter
        from escape_hw.calibration.sprint.fit import estimate_registration, sprint_options_from_config

        product, settings = self._product, self._config.calibration
        measured = product.result.measured or product.matrix
        yield Reporter("synthetic model", 1, "model")(0)
        estimate = yield from estimate_registration(
            measured,
            self._synthetic_model,
            modes=min(settings.sprint_modes, measured.n_modes),
            **sprint_options_from_config(settings),
        )
        return replace(product.result, matrix=measured, measured=None, registration=estimate)

    @cached_property
    def _synthetic_model(self) -> SyntheticModel:
        """The synthetic model; building that of a pyramid takes seconds."""
        from escape_hw.config.registry import model_factory

        return model_factory(self._config.calibration.model)(self._config, self._product.grid)

    def save_computed(self, folder: RunFolder, result: CalibrationResult, wall_seconds: float) -> SavedRun:
        """Save the measured matrix with its registration, the synthetic matrix, and the report."""
        from escape_hw.calibration.sprint.synthetic_matrix import synthesise_from_measurement
        from escape_hw.io import documents
        from escape_hw.io.fits.matrix import save_matrix
        from escape_hw.io.provenance import format_utc
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import write_run_result
        from escape_hw.runtime.session.record import config_provenance

        config, product = self._config, self._product
        estimate, measured, name = result.registration, result.matrix, product.path.name
        if estimate is None:
            raise RuntimeError("a fit without a registration")
        origin = replace(config_provenance(config), parents={name: product.sha256})
        folder.add_product("im", save_matrix(folder.file("im.fits"), result, origin))
        synthetic = synthesise_from_measurement(result, self._synthetic_model, estimate)
        folder.add_product("escape", save_matrix(folder.file("escape.fits"), synthetic, origin))
        document = write_run_result(
            folder,
            {
                **documents.header_fields("sprint", measured.system, measured.simulated, config.system.seed),
                "title": f"Registration of {measured.system}",
                **documents.calibration_document(result),
                "criteria": [criteria.sprint_converged(name, estimate)],
                "labels": {"im": {"column": ""}, "escape": {"column": ""}},
                "finished_utc": format_utc(),
                "wall_seconds": wall_seconds,
            },
        )
        return SavedRun(document, estimate.converged)
