"""What a task on a kept matrix begins with: the file, read once it is known to fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from escape_hw.runtime.task import fitting_matrix

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.fits import MatrixProduct


class MatrixTask:
    """The part of a :class:`~escape_hw.runtime.task.Task` that reads a matrix.

    Parameters
    ----------
    im
        File of the matrix.
    force
        Allow a simulated matrix on hardware.
    """

    overrides: tuple[str, ...] = ()

    def __init__(self, im: Path, *, force: bool = False) -> None:
        self._im, self._force = im, force
        self._config: SystemConfig | None = None
        self._product: MatrixProduct | None = None

    @property
    def config(self) -> SystemConfig:
        """The configuration, once loaded."""
        if self._config is None:
            raise RuntimeError("load() comes first")
        return self._config

    @property
    def product(self) -> MatrixProduct:
        """The matrix, once loaded."""
        if self._product is None:
            raise RuntimeError("load() comes first")
        return self._product

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """See :meth:`~escape_hw.runtime.task.Task.load`."""
        self._config, self._product = config, self._read(config, self._force or simulated)

    def _read(self, config: SystemConfig, simulated: bool) -> MatrixProduct:
        return fitting_matrix(self._im, config, simulated)

    def done(self) -> None:
        """Nothing was kept to go on with."""
