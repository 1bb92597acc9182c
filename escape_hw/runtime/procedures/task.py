"""Protocol of a procedure from request to saved result, and the base class of procedures that start from a matrix file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from escape_hw.errors import IncompatibleProduct

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SavedRun:
    """A result that was saved.

    Parameters
    ----------
    document
        The run's ``result.json``, products as whole paths.
    met
        Whether the run met its own criteria.
    """

    document: dict[str, Any] = field(default_factory=dict)
    met: bool = True


class Task(Protocol[T]):
    """One thing to do on an open bench. The methods are called in the order in which they stand here."""

    @property
    def kind(self) -> str:
        """What the run's folder is called after."""
        ...

    @property
    def overrides(self) -> tuple[str, ...]:
        """How it changes the configuration, ``section.key=value`` each."""
        ...

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read what it needs; nothing is opened by it.

        Parameters
        ----------
        config
            The system's configuration.
        simulated
            The devices are open already, and are a simulation whatever the mode says.

        Raises
        ------
        ConfigError
            Its parts do not go together.
        ProductError, IncompatibleProduct
            A file that it needs is damaged, or belongs elsewhere.
        """

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[T]:
        """The procedure that does it.

        Raises
        ------
        IncompatibleProduct
            A simulated matrix on hardware.
        """

    def save(self, folder: RunFolder, record: BenchRecord, result: T, wall_seconds: float) -> SavedRun:
        """Save, judge and report the result, a partial one as well.

        Raises
        ------
        StorageError
            It cannot be written.
        """

    def finish(self) -> None:
        """It came to its end, and nobody needs what was kept to go on with."""


def load_fitting_matrix(im: Path, config: SystemConfig, simulated: bool = False) -> MatrixProduct:
    """Read a matrix that belongs to this system, basis, mirror and mode; ``simulated``: in any mode.

    Raises
    ------
    ProductError, IncompatibleProduct
        It is damaged or belongs elsewhere.
    """
    from escape_hw.io.fits.matrix import load_matrix

    return load_matrix(
        im,
        expect_system=config.system.name,
        expect_sensor=config.sensor.kind,
        expect_basis=config.basis.kind,
        expect_modes=config.basis.n_modes,
        expect_actuators=config.devices.dm.n_act,
        allow_simulated=simulated or config.system.mode == "sim",
    )


def require_hardware_matrix(product: MatrixProduct, bench: Bench, force: bool) -> None:
    """Single devices may have a mode of their own: what was really opened decides.

    Raises
    ------
    IncompatibleProduct
        The matrix was made in simulation, and the bench is hardware.
    """
    if product.matrix.simulated and not bench.simulated and not force:
        raise IncompatibleProduct(
            f"{product.path}: made in simulation; it is not for hardware (--force overrides)"
        )


def set_overrides(settings: dict[str, object]) -> tuple[str, ...]:
    """Overrides of those settings that were given, ``None`` standing for as configured."""
    return tuple(f"{key}={value}" for key, value in settings.items() if value is not None)


class TaskWithMatrix:
    """The part of a :class:`~escape_hw.runtime.procedures.task.Task` that reads a matrix.

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
        """See :meth:`~escape_hw.runtime.procedures.task.Task.load`."""
        self._config, self._product = config, self._load_matrix(config, self._force or simulated)

    def _load_matrix(self, config: SystemConfig, simulated: bool) -> MatrixProduct:
        return load_fitting_matrix(self._im, config, simulated)

    def finish(self) -> None:
        """Nothing was kept to go on with."""
