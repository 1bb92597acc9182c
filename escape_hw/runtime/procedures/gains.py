"""Optical gains measured in closed loop, with a matrix of unknown scale."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.runtime.procedures.declaration import SavedRun, parameter
from escape_hw.runtime.procedures.matrix_input import (
    MatrixProcedure,
    load_fitting_matrix,
    require_hardware_matrix,
)

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord

#: Typical number of rounds, for the planned duration.
_TYPICAL_ROUNDS = 3


class GainsProcedure(MatrixProcedure["GainsRun"]):
    """Optical gains of a matrix of unknown scale, and the matrix rescaled with them."""

    name = "gains"
    title = "Optical gains"
    help = "Close the loop on a matrix of unknown scale and scale it to the turbulence, mode by mode."
    random_pokes = True

    poke: float = parameter(
        default=0.002,
        help="Last poke of each mode, rms surface as fraction of full stroke; lowered to the allowed "
        "Strehl loss.",
        unit="of full stroke", low=1e-6, high=1,
    )  # fmt: skip
    accuracy: float = parameter(
        default=0.01, help="Relative standard error of the gains at which the rounds end.", low=1e-5, high=1
    )
    allowed_strehl_loss: float = parameter(
        default=0.01, help="Share of the Strehl ratio that the last pokes may cost.", low=1e-5, high=1,
        deprecated=("budget",),
    )  # fmt: skip
    frames: int = parameter(
        default=20000, help="Largest number of frames per round.", unit="frame", low=1, high=1e8
    )
    gain: float | None = parameter(
        default=None, help="Gain of the loop, multiplied by the optical gain.", low=0.001, high=2,
        config_key="loop.gain",
    )  # fmt: skip
    other_matrices: tuple[Path, ...] = parameter(
        default=(), help="Another matrix whose gains are measured too; repeatable.", kind="matrices",
        on_server=False, deprecated=("beside",),
    )  # fmt: skip

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames of the model PSF and of a typical number of rounds."""
        return cls.preparation_frames(bench, arguments) + _TYPICAL_ROUNDS * int(arguments.get("frames") or 0)

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read all matrices."""
        super().load(config, simulated)
        self._other_products = {
            path.stem: load_fitting_matrix(path, config, self.force or simulated)
            for path in self.other_matrices
        }

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[GainsRun]:
        """Measure the model PSF, then the gains in closed loop."""
        from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
        from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix

        for each in (self.product, *self._other_products.values()):
            require_hardware_matrix(each, bench, self.force)
        model = yield from self.take_model_psf(bench)
        # Of a pseudo-synthetic matrix, also the gains of the measured one behind it.
        measured = self.product.result.measured
        comparisons = {} if measured is None else {"DO-CRIME": measured}
        comparisons |= {name: each.matrix for name, each in self._other_products.items()}
        return (
            yield from bootstrap_gains(
                bench, self.product.result, poke=self.poke, accuracy=self.accuracy,
                allowed_strehl_loss=self.allowed_strehl_loss, frames=self.frames, gain=self.gain,
                comparisons=comparisons, closed_loop_matrix=static_light_matrix(bench, self.product.result),
                model_psf=model,
            )
        )  # fmt: skip

    def save(self, folder: RunFolder, record: BenchRecord, result: GainsRun, wall_seconds: float) -> SavedRun:
        """Save gains, rescaled matrix and report."""
        from escape_hw.io.documents import gains_document
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import add_result, save_run

        found = result.result
        others = [each.path for each in self._other_products.values()]
        add_result(folder, record, "gains", found, self.product.path, *others)
        if found.rounds:
            add_result(folder, record, "im", result.rescaled_calibration, self.product.path)
        document = save_run(
            folder, record, "gains", f"Optical gains of {record.system}", wall_seconds,
            **gains_document(found),
            im=self.product.path.absolute(),
            criteria=[] if found.partial else [criteria.gains_converged(found)],
            labels={"im": {"label": "rescaled", "column": ""}},
        )  # fmt: skip
        return SavedRun(document, found.converged)
