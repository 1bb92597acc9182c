"""Calibration by any method: the procedures, their request and its saved state, and the result."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from escape_hw.config.choices import ESTIMATORS, POKE_PATTERNS
from escape_hw.config.renamed import update_document
from escape_hw.errors import ConfigError, IncompatibleProduct, ProductError
from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun, parameter, present_names
from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix, require_hardware_matrix
from escape_hw.runtime.procedures.sprint import SprintParameters

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import CalibrationResult
    from escape_hw.api.sensor import SensorGeometry
    from escape_hw.bench import Bench
    from escape_hw.calibration.acquisition.checkpoint import Checkpoint
    from escape_hw.calibration.acquisition.stopping import Target
    from escape_hw.config.system import CalibrationSection, SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


#: Frames that a plan expects to be discarded after each push and pull.
_SETTLING_FRAMES = 2


def _frames(config_key: str, help: str = "Frames to measure with.") -> Any:
    return parameter(default=None, help=help, unit="frame", low=1, high=1e8, config_key=config_key)


def _poke(config_key: str) -> Any:
    return parameter(
        default=None, help="Poke of each mode, rms surface as fraction of full stroke.",
        unit="of full stroke", low=1e-6, high=1, config_key=config_key,
    )  # fmt: skip


class CalibrationProcedure(ProcedureSpec["CalibrationResult"]):
    """Base class of the calibrations; ``name`` is the method."""

    frames: int | None = _frames("calibration.frames")
    poke: float | None = _poke("calibration.poke")
    snr: float | None = parameter(
        default=None, help="Stop when every mode has this signal-to-noise ratio.", label="SNR goal", low=0.01
    )
    resume: Path | None = parameter(
        default=None, help="Continue an incomplete run, given by its folder.", label="Resume run", kind="run",
        last=True,
    )  # fmt: skip
    force: bool = parameter(
        default=False, help="Allow a simulated matrix on hardware.", on_server=False, last=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self._checkpoint: Checkpoint | None = None
        self._control_matrix: MatrixProduct | None = None

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any], label: Callable[[str], str] = str) -> Self:
        """A request from arguments; those of the run to resume count where none are given.

        Raises
        ------
        ConfigError
            An argument is wrong.
        ProductError
            The run cannot be resumed.
        """
        resume = arguments.get("resume")
        if resume is None:
            return super().from_arguments(arguments, label)
        given = {
            name: value
            for name, value in present_names(cls.parameters(), arguments, label).items()
            if value is not None
        }
        known = {one.name for one in cls.parameters()}
        saved = {name: value for name, value in saved_request(Path(resume)).items() if name in known}
        return super().from_arguments({**saved, **given}, label)

    @classmethod
    def settings_of_run(cls, folder: Path) -> dict[str, Any]:
        """Values, in the configuration of an earlier run, of the parameters that set configuration keys.

        Raises
        ------
        ProductError
            The folder holds no readable configuration.
        """
        path = folder / "config.toml"
        try:
            config = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ProductError(
                f"{path}: cannot be read ({error}); is {folder} the folder of a run?"
            ) from error
        update_document(config)
        found = {}
        for one in cls.parameters():
            if one.sets_config:
                section, _, key = one.config_key.partition(".")
                value = config.get(section, {}).get(key)
                found[one.name] = ",".join(value) if isinstance(value, list) else value
        return found

    @property
    def kind(self) -> str:
        """Part of the run folder's name."""
        return f"calibrate-{self.name}"

    @property
    def target(self) -> tuple[float | None, float | None]:
        """Signal-to-noise ratio and accuracy at which the run stops."""
        return self.snr, None

    def request(self) -> dict[str, Any]:
        """Method and arguments as plain values, saved with the state of the run for ``resume``."""
        left_out = ("resume", "force")
        values = {
            one.name: getattr(self, one.name)
            for one in self.parameters()
            if not one.sets_config and one.name not in left_out
        }
        plain = {
            name: str(value.absolute()) if isinstance(value, Path) else value
            for name, value in values.items()
        }
        return {"method": self.name, **plain}

    def method_options(self) -> dict[str, Any]:
        """Arguments of :func:`calibrate_with_method` that not all methods have."""
        return {}

    def _is_short_run(self, bench: Bench) -> bool:
        """Whether the run is too short for a measured matrix, so that it cannot be resumed."""
        return False

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Refuse too few frames, and a state to resume from that is of another run."""
        control, c = self._control_matrix, config.calibration
        self._require_enough_frames(c, config.basis.n_modes if control is None else control.matrix.n_modes)
        if self.resume is None:
            return
        from escape_hw.calibration.acquisition.checkpoint import require_same_run
        from escape_hw.io.fits.run_state import STATE_FILE, load_state

        method, path = saved_request(self.resume)["method"], self.resume / STATE_FILE
        if method != self.name:
            raise IncompatibleProduct(
                f"{path}: its method is {method!r}, this run's is {self.name!r}; resume with that method, or "
                "start a new run"
            )
        now = {
            "system": config.system.name,
            "settings": self._settings_to_resume(c),
            "configuration": config.to_toml(),
        }
        require_same_run(path, load_state(path).identity, now)

    def _require_enough_frames(self, c: CalibrationSection, n_modes: int) -> None:
        """Raise :class:`TooFewFrames` for a run that cannot give a result."""

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        """Settings of the saved state that must be the same, as far as they are known without a bench."""
        return {}

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[CalibrationResult]:
        """Calibrate; the state is saved in the folder meanwhile, so that the run can be resumed."""
        from escape_hw.calibration.acquisition.checkpoint import Checkpoint
        from escape_hw.calibration.acquisition.stopping import Target
        from escape_hw.io.fits.run_state import STATE_FILE

        if self._control_matrix is not None:
            require_hardware_matrix(self._control_matrix, bench, self.force)
        if folder is not None:
            source = None if self.resume is None else self.resume / STATE_FILE
            # A short run cannot be resumed; escape() refuses to resume one.
            if source is not None or not self._is_short_run(bench):
                self._checkpoint = Checkpoint(folder.file(STATE_FILE), source, request=self.request())
        return calibrate_with_method(
            bench, self.name, frames=self.frames, poke=self.poke, **self.method_options(),
            closed_loop=None if self._control_matrix is None else self._control_matrix.result,
            until=None if self.target == (None, None) else Target(*self.target), checkpoint=self._checkpoint,
        )  # fmt: skip

    def save(
        self, folder: RunFolder, record: BenchRecord, result: CalibrationResult, wall_seconds: float
    ) -> SavedRun:
        """Save the matrix, the measured matrix behind a pseudo-synthetic one, and the report."""
        from escape_hw.io.documents import calibration_document
        from escape_hw.runtime.procedures.products import add_result, save_run

        measured = measured_calibration(result)
        labels: dict[str, Any] = {"im": {"measured": "DO-CRIME", "column": ""}}
        parents = () if self._control_matrix is None else (self._control_matrix.path,)
        if measured is not None:
            parents = (add_result(folder, record, "docrime", measured, *parents),)
            labels["docrime"] = {"label": "DO-CRIME"}
        add_result(folder, record, "im", result, *parents)
        checks = self._criteria(result)
        document = save_run(
            folder, record, "calibrate", f"Calibration of {record.system}", wall_seconds,
            **calibration_document(result),
            criteria=checks,
            labels=labels,
        )  # fmt: skip
        return SavedRun(document, all(entry["met"] for entry in checks))

    def _criteria(self, result: CalibrationResult) -> list[dict[str, Any]]:
        from escape_hw.runtime.procedures import criteria

        if result.partial:
            return []
        checks, (snr, accuracy) = [], self.target
        if result.matrix.method == "escape":
            checks.append(criteria.sprint_converged("ESCAPE", result.registration))
        if accuracy is not None and result.registration is not None:
            worst = float(result.registration.sigma[:2].max())
            text = f"standard error of the shifts: {worst:.3g} (target {accuracy:g}) % of a sub-aperture"
            checks.append(criteria.criterion(text, worst <= accuracy))
        if snr is not None:
            least = float((result.measured or result.matrix).snr().min())
            text = f"signal-to-noise ratio of the weakest mode: {least:.3g} (target {snr:g})"
            checks.append(criteria.criterion(text, least >= snr))
        return checks

    def finish(self) -> None:
        """Remove the saved state."""
        if self._checkpoint is not None:
            self._checkpoint.remove()


class ClosedLoopCalibration(CalibrationProcedure):
    """Base class of the calibrations that also work in closed loop."""

    closed_loop: Path | None = parameter(
        default=None, help="Measure in closed loop, with this control matrix.",
        label="Control matrix", kind="matrix", deprecated=("closing",),
    )  # fmt: skip

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read the control matrix."""
        if self.closed_loop is not None:
            self._control_matrix = load_fitting_matrix(self.closed_loop, config, self.force or simulated)
        super().load(config, simulated)

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        from escape_hw.calibration.acquisition.checkpoint import CLOSED_WITH, fingerprint

        control = self._control_matrix
        return {CLOSED_WITH: None if control is None else fingerprint(control.matrix.data)}


class DocrimeProcedure(ClosedLoopCalibration):
    """DO-CRIME: random pokes of all modes at once."""

    name = "docrime"
    title = "DO-CRIME"
    help = "Measure an interaction matrix with random pokes of all modes at once, with or without turbulence."
    random_pokes = True

    pokes: str | None = parameter(
        default=None, help="Poke sequence of DO-CRIME.", choices=POKE_PATTERNS,
        config_key="calibration.pokes", sets_config=True,
    )  # fmt: skip
    whiten: bool = parameter(
        default=True, help="Whiten the turbulence; otherwise the paper's estimator, in open loop only.",
        label="Whiten turbulence", deprecated_inverse=("plain",),
    )  # fmt: skip

    def validate(self) -> None:
        """Refuse the paper's estimator in closed loop."""
        if not self.whiten and self.closed_loop is not None:
            raise ConfigError("whiten = false (--no-whiten) works in open loop only; leave out closed_loop")

    def method_options(self) -> dict[str, Any]:
        """Whether the turbulence is whitened."""
        return {"whiten": self.whiten}

    def _require_enough_frames(self, c: CalibrationSection, n_modes: int) -> None:
        from escape_hw.calibration.docrime.open_loop import require_enough_frames

        require_enough_frames(c, c.frames if self.frames is None else self.frames, n_modes, self.whiten)

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        settings = {**super()._settings_to_resume(c), "poke": c.poke if self.poke is None else self.poke}
        return settings if self.closed_loop is not None else {**settings, "whiten": self.whiten}


class EscapeProcedure(DocrimeProcedure, SprintParameters["CalibrationResult"]):
    """ESCAPE: DO-CRIME, SPRINT, and the pseudo-synthetic matrix."""

    name = "escape"
    title = "ESCAPE"
    help = (
        "Measure with DO-CRIME, estimate the registration with SPRINT, compute the pseudo-synthetic matrix."
    )

    accuracy: float | None = parameter(
        default=None, help="Stop when the standard errors of the shifts are this small.",
        label="Accuracy goal", unit="% of a sub-aperture", low=1e-6,
    )  # fmt: skip
    estimator: str | None = parameter(
        default=None, help="Data that SPRINT fits; telemetry needs the fewest frames.", choices=ESTIMATORS,
        config_key="calibration.estimator",
    )  # fmt: skip

    @property
    def target(self) -> tuple[float | None, float | None]:
        """Signal-to-noise ratio and accuracy at which the run stops."""
        return self.snr, self.accuracy

    def method_options(self) -> dict[str, Any]:
        """Whether the turbulence is whitened, and the data that are fitted."""
        return {"whiten": self.whiten, "estimator": self.estimator}

    def _require_enough_frames(self, c: CalibrationSection, n_modes: int) -> None:
        from escape_hw.calibration.acquisition.stopping import Target
        from escape_hw.calibration.escape.method import require_enough_frames_for_escape

        require_enough_frames_for_escape(
            c, n_modes, frames=c.frames if self.frames is None else self.frames,
            until=None if self.target == (None, None) else Target(*self.target), checkpoint=self.resume,
            **self.method_options(),
        )  # fmt: skip

    def _is_short_run(self, bench: Bench) -> bool:
        from escape_hw.calibration.escape.method import is_short_run

        c, closed_loop = bench.config, self._control_matrix
        n_modes = c.basis.n_modes if closed_loop is None else closed_loop.matrix.n_modes
        return is_short_run(c.calibration, n_modes, frames=self.frames, **self.method_options())


class PushPullProcedure(CalibrationProcedure):
    """Push-pull: one mode after the other, averaged over frames."""

    name = "push-pull"
    title = "Push-pull"
    help = "Measure an interaction matrix mode by mode; needs a source without turbulence."

    frames: int | None = _frames("calibration.push_pull_frames", "Frames per push and per pull.")
    poke: float | None = _poke("calibration.push_pull_poke")

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        return {
            "poke": c.push_pull_poke if self.poke is None else self.poke,
            "frames": c.push_pull_frames if self.frames is None else self.frames,
        }

    @classmethod
    def preparation_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Frames of set-up and settling test."""
        from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES
        from escape_hw.calibration.push_pull.procedure import TEST_STEP_FRAMES

        return SETUP_FRAMES + TEST_STEP_FRAMES

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Frames of the preparation, and of a push and a pull per mode."""
        per_mode = 2 * (int(arguments.get("frames") or 0) + _SETTLING_FRAMES)
        return cls.preparation_frames(bench, arguments) + bench.config.basis.n_modes * per_mode


class FastPushPullProcedure(ClosedLoopCalibration):
    """Fast push-pull: one mode after the other, a push and a pull within two frames."""

    name = "push-pull-fast"
    title = "Fast push-pull"
    help = "Measure an interaction matrix mode by mode, with a push and a pull within two frames."

    poke: float | None = _poke("calibration.push_pull_poke")

    def _require_enough_frames(self, c: CalibrationSection, n_modes: int) -> None:
        from escape_hw.calibration.docrime.open_loop import require_enough_frames

        require_enough_frames(c, c.frames if self.frames is None else self.frames, n_modes)

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        poke = c.push_pull_poke if self.poke is None else self.poke
        return {**super()._settings_to_resume(c), "poke": poke}


class ModulatedProcedure(CalibrationProcedure):
    """Modulation-demodulation: several modes at once, on distinct frequencies."""

    name = "modulated"
    title = "Modulation"
    help = "Measure an interaction matrix with several modes at once, each at its own frequency."

    frames: int | None = _frames("calibration.modulated_frames", "Frames per batch of modes.")

    def _require_enough_frames(self, c: CalibrationSection, n_modes: int) -> None:
        from escape_hw.calibration.push_pull.demodulation import choose_line_frequencies
        from escape_hw.calibration.push_pull.modulation import BAND

        choose_line_frequencies(n_modes, self._settings_to_resume(c)["frames"], BAND)

    def _settings_to_resume(self, c: CalibrationSection) -> dict[str, Any]:
        # The poke that is saved is limited by the mirror.
        return {"frames": c.modulated_frames if self.frames is None else self.frames}

    @classmethod
    def preparation_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Frames of the set-up."""
        from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES

        return SETUP_FRAMES

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Frames of the set-up and of all batches."""
        from escape_hw.calibration.push_pull.demodulation import choose_line_frequencies
        from escape_hw.calibration.push_pull.modulation import BAND, SETTLING_FRAMES
        from escape_hw.errors import TooFewFrames

        frames, n_modes = int(arguments.get("frames") or 0), bench.config.basis.n_modes
        prepare = cls.preparation_frames(bench, arguments)
        try:
            at_once = choose_line_frequencies(n_modes, frames, BAND).size
        except TooFewFrames:
            return prepare + frames
        return prepare + -(-n_modes // at_once) * (frames + SETTLING_FRAMES)


#: The calibrations by method.
CALIBRATIONS: dict[str, type[CalibrationProcedure]] = {
    procedure.name: procedure
    for procedure in (
        PushPullProcedure, FastPushPullProcedure, ModulatedProcedure, DocrimeProcedure, EscapeProcedure,
    )
}  # fmt: skip
METHODS = tuple(CALIBRATIONS)
#: Methods that also work in closed loop.
CLOSED_LOOP = tuple(name for name, each in CALIBRATIONS.items() if issubclass(each, ClosedLoopCalibration))


def saved_request(folder: Path) -> dict[str, Any]:
    """Method and arguments of an incomplete run, under their present names.

    Raises
    ------
    ProductError
        The folder holds no state to resume from.
    """
    from escape_hw.io.fits.run_state import STATE_FILE, load_state

    path = folder / STATE_FILE
    if not path.is_file() and (folder / "report.html").is_file():
        raise ProductError(
            f"{folder} is complete, there is nothing to resume; its report is {folder / 'report.html'}, "
            f"and 'escape show {folder}' prints its result"
        )
    if not path.is_file():
        raise ProductError(
            f"{path}: does not exist; {folder} is not the folder of a run, or the run was stopped in its "
            "first seconds, or it is complete"
        )
    request = {name: value for name, value in load_state(path).values["request"].items() if value is not None}
    if "plain" in request:
        # Name in version 0.1.0.
        request["whiten"] = not request.pop("plain")
    return request


def measured_calibration(result: CalibrationResult) -> CalibrationResult | None:
    """The measured matrix behind a pseudo-synthetic one as a calibration of its own; ``None`` without one."""
    if result.measured is None:
        return None
    return replace(result, matrix=result.measured, measured=None, registration=None, notes=())


def calibrate_with_method(
    bench: Bench,
    method: str = "escape",
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    whiten: bool = True,
    estimator: str | None = None,
    closed_loop: CalibrationResult | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Calibrate with one of :data:`METHODS`; during push-pull a movable phase screen is out of the beam.

    ``frames``, ``poke``, ``whiten`` and ``estimator`` are parameters of the procedures, see for example
    :class:`EscapeProcedure`. The matrix of ``closed_loop`` closes the loop during the measurement, with a
    method of :data:`CLOSED_LOOP`. The sensor geometry ``grid`` is found on frames by default, ``until`` ends
    the run at a target, ``checkpoint`` is the file for its state and the state to resume from.

    Raises
    ------
    ConfigError
        The method is unknown, or the options exclude each other; nothing has moved.
    TooFewFrames, CalibrationError, Aborted
        See :func:`~escape_hw.calibration.push_pull.procedure.push_pull`,
        :func:`~escape_hw.calibration.docrime.open_loop.docrime`,
        :func:`~escape_hw.calibration.escape.method.escape`.
    """
    from escape_hw.runtime.session.record import without_turbulence

    if method not in METHODS:
        raise ConfigError(f"calibration method '{method}' is unknown; it is one of {', '.join(METHODS)}")
    if closed_loop is not None and method not in CLOSED_LOOP:
        raise ConfigError(f"'{method}' works in open loop only; in closed loop: {', '.join(CLOSED_LOOP)}")
    if closed_loop is not None and not whiten:
        raise ConfigError("whiten = False works in open loop only; in closed loop the turbulence is whitened")
    common: dict[str, Any] = {"frames": frames, "poke": poke, "until": until, "checkpoint": checkpoint}
    if method == "push-pull":
        from escape_hw.calibration.push_pull.procedure import push_pull

        with without_turbulence(bench):
            return (yield from push_pull(bench, grid=grid, **common))
    if method == "modulated":
        from escape_hw.calibration.push_pull.modulation import modulation_demodulation

        return (yield from modulation_demodulation(bench, grid=grid, **common))
    if method == "escape":
        from escape_hw.calibration.escape.method import escape

        return (
            yield from escape(
                bench, grid=grid, whiten=whiten, estimator=estimator, closed_loop=closed_loop, **common
            )
        )
    if method == "push-pull-fast":
        from escape_hw.calibration.acquisition.pokes import PushPullPokes

        common["pattern"] = PushPullPokes
        common["poke"] = bench.config.calibration.push_pull_poke if poke is None else poke
    if closed_loop is not None:
        from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop

        return (yield from docrime_closed_loop(bench, closed_loop, **common))
    from escape_hw.calibration.docrime.open_loop import docrime

    return (yield from docrime(bench, grid=grid, whiten=whiten, **common))
