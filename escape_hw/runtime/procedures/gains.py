"""The bootstrap of optical gains, from the request to the kept gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.procedures.task import (
    SavedRun,
    TaskWithMatrix,
    load_fitting_matrix,
    require_hardware_matrix,
)

if TYPE_CHECKING:
    from escape_hw.api.interaction_matrix import InteractionMatrix
    from escape_hw.bench import Bench
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


class GainsTask(TaskWithMatrix):
    """A bootstrap of optical gains; see :class:`~escape_hw.runtime.procedures.task.Task`.

    Parameters
    ----------
    im
        File of the matrix to scale.
    beside
        Files of other matrices whose gains are wanted.
    strehl
        Measure the model PSF and the Strehl ratios.
    force
        Allow a simulated matrix on hardware.
    options
        ``poke``, ``accuracy``, ``budget``, ``frames`` and ``gain`` of
        :func:`~escape_hw.calibration.optical_gain.bootstrap.bootstrap_gains`.
    """

    kind = "gains"

    def __init__(
        self,
        im: Path,
        *,
        beside: Sequence[Path] = (),
        strehl: bool = True,
        force: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(im, force=force)
        self._paths, self._strehl, self._options = tuple(beside), strehl, dict(options or {})
        self._other_matrices: dict[str, MatrixProduct] = {}

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.load`."""
        super().load(config, simulated)
        any_mode = self._force or simulated
        self._other_matrices = {
            path.stem: load_fitting_matrix(path, config, any_mode) for path in self._paths
        }

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[GainsRun]:
        """Model PSF where the bench can take one, then the bootstrap."""
        from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
        from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix
        from escape_hw.runtime.procedures.calibration import model_psf

        for each in (self.product, *self._other_matrices.values()):
            require_hardware_matrix(each, bench, self._force)
        model = None
        if self._strehl and bench.science is not None:
            model = yield from model_psf(bench)
        return (
            yield from bootstrap_gains(
                bench,
                self.product.result,
                **self._options,
                comparisons=self._comparison_matrices(),
                closed_loop_matrix=static_light_matrix(bench, self.product.result),
                model_psf=model,
            )
        )

    def _comparison_matrices(self) -> dict[str, InteractionMatrix]:
        """The other matrices, and the measured one that a pseudo-synthetic one was computed from."""
        measured = self.product.result.measured
        known = {} if measured is None else {"DO-CRIME": measured}
        return {**known, **{name: each.matrix for name, each in self._other_matrices.items()}}

    def save(self, folder: RunFolder, record: BenchRecord, result: GainsRun, wall_seconds: float) -> SavedRun:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.save`."""
        from escape_hw.io.documents import gains_document
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import add_calibration, add_gains, write_run_result

        found = result.result
        parents = {
            "im": self.product.path,
            **{name: each.path for name, each in self._other_matrices.items()},
        }
        add_gains(folder, record, "gains", found, parents)
        if found.rounds:
            add_calibration(folder, record, "im", result.rescaled_calibration, {"im": self.product.path})
        document = write_run_result(
            folder,
            {
                **record.header_fields("gains"),
                "title": f"Optical gains of {record.system}",
                **gains_document(found),
                "im": self.product.path.absolute(),
                "criteria": [] if found.partial else [criteria.gains_converged(found)],
                "labels": {"im": {"label": "rescaled", "column": ""}},
                **record.footer_fields(wall_seconds),
            },
        )
        return SavedRun(document, found.converged)
