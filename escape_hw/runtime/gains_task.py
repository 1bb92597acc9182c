"""The bootstrap of optical gains, from the request to the kept gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.procedure import Procedure
from escape_hw.runtime.matrix_task import MatrixTask
from escape_hw.runtime.task import Kept, fitting_matrix, refuse_simulated

if TYPE_CHECKING:
    from escape_hw.api.matrix import InteractionMatrix
    from escape_hw.bench import Bench
    from escape_hw.calibration.gain_bootstrap import GainsRun
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


class GainsTask(MatrixTask):
    """A bootstrap of optical gains; see :class:`~escape_hw.runtime.task.Task`.

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
        :func:`~escape_hw.calibration.gain_bootstrap.bootstrap_gains`.
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
        self._others: dict[str, MatrixProduct] = {}

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """See :meth:`~escape_hw.runtime.task.Task.load`."""
        super().load(config, simulated)
        any_mode = self._force or simulated
        self._others = {path.stem: fitting_matrix(path, config, any_mode) for path in self._paths}

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[GainsRun]:
        """Model PSF where the bench can take one, then the bootstrap."""
        from escape_hw.calibration.gain_bootstrap import bootstrap_gains
        from escape_hw.calibration.pseudo_synthetic import at_rest
        from escape_hw.runtime.procedures import model_psf

        for each in (self.product, *self._others.values()):
            refuse_simulated(each, bench, self._force)
        model = None
        if self._strehl and bench.science is not None:
            model = yield from model_psf(bench)
        return (
            yield from bootstrap_gains(
                bench,
                self.product.result,
                **self._options,
                beside=self._beside(),
                shape=at_rest(bench, self.product.result),
                model_psf=model,
            )
        )

    def _beside(self) -> dict[str, InteractionMatrix]:
        """The other matrices, and the measured one that a pseudo-synthetic one was computed from."""
        measured = self.product.result.measured
        known = {} if measured is None else {"DO-CRIME": measured}
        return {**known, **{name: each.matrix for name, each in self._others.items()}}

    def keep(self, folder: RunFolder, record: BenchRecord, result: GainsRun, wall_seconds: float) -> Kept:
        """See :meth:`~escape_hw.runtime.task.Task.keep`."""
        from escape_hw.io.documents import gains_document
        from escape_hw.runtime import criteria
        from escape_hw.runtime.keep import finish, keep_calibration, keep_gains

        found = result.result
        parents = {"im": self.product.path, **{name: each.path for name, each in self._others.items()}}
        keep_gains(folder, record, "gains", found, parents)
        if found.rounds:
            keep_calibration(folder, record, "im", result.rescaled, {"im": self.product.path})
        document = finish(
            folder,
            {
                **record.head("gains"),
                "title": f"Optical gains of {record.system}",
                **gains_document(found),
                "im": self.product.path.absolute(),
                "criteria": [] if found.partial else [criteria.gains_converged(found)],
                "labels": {"im": {"label": "rescaled", "column": ""}},
                **record.tail(wall_seconds),
            },
        )
        return Kept(document, found.converged)
