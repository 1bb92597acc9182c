"""Registry of the procedures a server offers: parameters, validation of arguments, construction of tasks."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES
from escape_hw.config.renamed import present_value, update_document
from escape_hw.config.system import ESTIMATORS, LOSSES, MODES_CHOICES, SOLVERS, SystemConfig
from escape_hw.errors import ConfigError, ProductError
from escape_hw.remote.state import Arguments, ProcedureEntry, ProcedureParameter
from escape_hw.runtime.procedures.calibration import CLOSED_LOOP, CalibrationRequest, CalibrationTask
from escape_hw.runtime.procedures.gains import GainsTask
from escape_hw.runtime.procedures.loop import LoopTask
from escape_hw.runtime.procedures.model_psf import ModelPsfTask
from escape_hw.runtime.procedures.sensor import SensorTask
from escape_hw.runtime.procedures.sprint import SprintTask
from escape_hw.runtime.procedures.task import Task
from escape_hw.runtime.procedures.track import TrackTask
from escape_hw.server.engine.product_store import ProductStore

Value = float | int | bool | str | None


def check_arguments(parameters: Sequence[ProcedureParameter], arguments: Mapping[str, Value]) -> Arguments:
    """Every argument with its value, defaults where nothing is said.

    Raises
    ------
    ConfigError
        Unknown, of the wrong kind or out of range; all that is wrong at once, with the way out.
    """
    known = {parameter.name: parameter for parameter in parameters}
    wrong = [_unknown_message(name, known) for name in arguments if name not in known]
    values: Arguments = {}
    for name, parameter in known.items():
        value = arguments.get(name)
        if value is None:
            values[name] = parameter.default
            continue
        try:
            values[name] = _check_value(parameter, present_value(f"calibration.{name}", value))
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("; ".join(wrong))
    return values


def _unknown_message(name: str, known: Mapping[str, ProcedureParameter]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known) or 'none'}"
    return f"'{name}' is no argument of this procedure; {hint}"


def _check_value(parameter: ProcedureParameter, value: Value) -> Value:
    name = parameter.name
    if parameter.kind == "bool":
        if not isinstance(value, bool):
            raise ConfigError(f"{name} is {value!r}; it must be true or false")
        return value
    if parameter.kind in ("int", "float"):
        return _check_number(parameter, value)
    if not isinstance(value, str):
        raise ConfigError(f"{name} is {value!r}; it must be text")
    if parameter.kind == "choice" and value not in parameter.choices:
        raise ConfigError(f"{name} is '{value}'; it is one of {', '.join(parameter.choices)}")
    return value


def _check_number(parameter: ProcedureParameter, value: Value) -> float | int:
    name, whole = parameter.name, parameter.kind == "int"
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{name} is {value!r}; it must be a number")
    if whole and value != int(value):
        raise ConfigError(f"{name} is {value!r}; it must be a whole number")
    low, high = parameter.low, parameter.high
    if (low is not None and value < low) or (high is not None and value > high):
        unit = f" {parameter.unit}" if parameter.unit else ""
        least = "" if low is None else f"at least {low:g}"
        most = "" if high is None else f"at most {high:g}"
        raise ConfigError(
            f"{name} is {value:g}; it must be {' and '.join(filter(None, (least, most)))}{unit}"
        )
    return int(value) if whole else float(value)


#: Science frames of a model PSF.
_PSF_FRAMES = 20
#: DO-CRIME's pokes, as the configuration names them.
_POKE_PATTERNS: tuple[str, ...] = ("white", "anticorrelated", "equal-snr")


@dataclass(frozen=True, slots=True)
class RegisteredProcedure:
    """One procedure.

    Parameters
    ----------
    make
        Makes the task of the arguments.
    """

    entry: ProcedureEntry
    build_task: Callable[[Arguments, ProductStore], Task[Any]]

    @property
    def name(self) -> str:
        """Its name."""
        return self.entry.name


def _frames_parameter(default: int, help: str = "Frames to take.") -> ProcedureParameter:
    return ProcedureParameter(
        name="frames", kind="int", default=default, unit="frame", low=1, high=1e8, help=help
    )


def _poke_parameter(default: float) -> ProcedureParameter:
    return ProcedureParameter(
        name="poke", kind="float", default=default, unit="of full stroke", low=1e-6, high=1,
        help="Rms surface of each mode's poke.",
    )  # fmt: skip


_SNR = ProcedureParameter(
    name="snr", kind="float", low=0.01, help="Stop when every mode has this signal-to-noise ratio."
)
_IM = ProcedureParameter(name="im", kind="matrix", help="Interaction matrix to close the loop with.")
_MEASURED_IM = ProcedureParameter(name="im", kind="matrix", help="Interaction matrix that was measured.")
_CLOSED_LOOP_IM = ProcedureParameter(
    name="closed_loop", kind="matrix", help="Measure in closed loop, with this matrix."
)
_RESUME = ProcedureParameter(
    name="resume", kind="text", help="Folder of a run that was broken off, to go on with it."
)
_STREHL = ProcedureParameter(
    name="strehl", kind="bool", default=True, help="Measure the model PSF and the Strehl ratios."
)


def _gain_parameter(config: SystemConfig) -> ProcedureParameter:
    return ProcedureParameter(
        name="gain", kind="float", default=config.loop.gain, low=0.001, high=2, help="Gain of the loop."
    )


def _solver_parameter(config: SystemConfig) -> ProcedureParameter:
    return ProcedureParameter(
        name="solver", kind="choice", default=config.calibration.solver, choices=SOLVERS,
        help="How SPRINT solves.",
    )  # fmt: skip


def _calibration_procedures(config: SystemConfig) -> list[RegisteredProcedure]:
    c = config.calibration
    accuracy = ProcedureParameter(
        name="accuracy", kind="float", unit="% of a sub-aperture", low=1e-6,
        help="Stop when the shifts are known to this.",
    )  # fmt: skip
    estimator = ProcedureParameter(
        name="estimator", kind="choice", default=c.estimator, choices=ESTIMATORS, help="What SPRINT fits."
    )
    pokes = ProcedureParameter(
        name="pokes", kind="choice", default=c.pokes, choices=_POKE_PATTERNS, help="Kind of pokes."
    )
    plain = ProcedureParameter(
        name="plain", kind="bool", default=False, help="The paper's estimator, turbulence not whitened."
    )
    white = (_frames_parameter(c.frames), _poke_parameter(c.poke), _SNR)
    each = (
        _frames_parameter(c.push_pull_frames, "Frames per push and per pull."),
        _poke_parameter(c.push_pull_poke),
        _SNR,
    )
    batch = (
        _frames_parameter(c.modulated_frames, "Frames per batch of modes."),
        _poke_parameter(c.poke),
        _SNR,
    )
    fast = (_frames_parameter(c.frames), _poke_parameter(c.push_pull_poke), _SNR, _CLOSED_LOOP_IM)
    declared = [
        ("escape", "ESCAPE", "Pokes under turbulence, SPRINT, pseudo-synthetic matrix.",
         (*white, accuracy, estimator, _solver_parameter(config), pokes, _CLOSED_LOOP_IM)),
        ("docrime", "DO-CRIME", "Interaction matrix by random pokes, under turbulence or not.",
         (*white, pokes, plain, _CLOSED_LOOP_IM)),
        ("push-pull", "Push-pull", "Interaction matrix mode by mode; needs a source.", each),
        ("push-pull-fast", "Fast push-pull", "Push and pull within two frames.", fast),
        ("modulated", "Modulation", "Several modes at once, each on a frequency of its own.", batch),
    ]  # fmt: skip
    return [
        RegisteredProcedure(
            ProcedureEntry(name=name, title=title, help=help, parameters=(*parameters, _RESUME)),
            _calibration_task(name),
        )
        for name, title, help, parameters in declared
    ]


def _calibration_task(method: str) -> Callable[[Arguments, ProductStore], Task[Any]]:
    def build_task(arguments: Arguments, product_store: ProductStore) -> Task[Any]:
        options: dict[str, Any] = {"method": method, **arguments}
        settings: dict[str, object] = {key: options.pop(key, None) for key in ("pokes", "solver")}
        resume = options.pop("resume")
        control_matrix = options.pop("closed_loop", None)
        if control_matrix is not None and method in CLOSED_LOOP:
            options["closed_loop"] = str(product_store.matrix(str(control_matrix)))
        folder = None if resume is None else product_store.readable_path(str(resume))
        if folder is not None:
            saved_settings = _run_settings(folder)
            settings = {
                key: saved_settings.get(key) if value is None else value for key, value in settings.items()
            }
        if method != "escape" or settings.get("solver") is None:
            settings.pop("solver")
        return CalibrationTask(
            CalibrationRequest.from_options(options, folder), resume=folder, settings=settings
        )

    return build_task


def _run_settings(folder: Path) -> dict[str, Any]:
    """The section ``calibration`` of the configuration of the run in a folder."""
    path = folder / "config.toml"
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ProductError(f"{path}: cannot be read ({error}); is {folder} the folder of a run?") from error
    update_document(document)
    return dict(document.get("calibration", {}))


def _matrix_path(arguments: Arguments, product_store: ProductStore) -> Path:
    name = arguments.pop("im")
    if name is None:
        raise ConfigError("im is missing; name a matrix that the server holds")
    return product_store.matrix(str(name))


def _loop_task(arguments: Arguments, product_store: ProductStore) -> Task[Any]:
    options: dict[str, Any] = dict(arguments)
    path = _matrix_path(options, product_store)
    if options["best"]:
        options["gain"] = None
    return LoopTask(path, **options)


def _gains_task(arguments: Arguments, product_store: ProductStore) -> Task[Any]:
    options: dict[str, Any] = dict(arguments)
    path = _matrix_path(options, product_store)
    return GainsTask(path, strehl=options.pop("strehl"), options=options)


def _track_task(arguments: Arguments, product_store: ProductStore) -> Task[Any]:
    options: dict[str, Any] = dict(arguments)
    return TrackTask(_matrix_path(options, product_store), **options)


def _sprint_task(arguments: Arguments, product_store: ProductStore) -> Task[Any]:
    options: dict[str, Any] = dict(arguments)
    return SprintTask(_matrix_path(options, product_store), settings=options)


def _other_procedures(config: SystemConfig) -> list[RegisteredProcedure]:
    gain, t = _gain_parameter(config), config.tracking
    leak = ProcedureParameter(
        name="leak", kind="float", default=config.loop.leak, low=0, high=1, help="Leak per frame."
    )
    dropped = ProcedureParameter(
        name="dropped_modes", kind="int", default=config.loop.dropped_modes, low=0,
        high=config.basis.n_modes - 1, help="Eigenmodes left out of the reconstructor.",
    )  # fmt: skip
    best = ProcedureParameter(name="best", kind="bool", default=False, help="Look for the best gain first.")
    accuracy = ProcedureParameter(
        name="accuracy", kind="float", default=0.01, low=1e-5, high=1, help="Relative error of the gains."
    )
    budget = ProcedureParameter(
        name="budget", kind="float", default=0.01, low=1e-5, high=1, help="Strehl ratio that pokes may cost."
    )
    seconds = ProcedureParameter(
        name="seconds", kind="float", default=60.0, unit="s", low=1, high=1e6, help="How long."
    )
    memory = ProcedureParameter(
        name="memory", kind="float", default=t.memory_s, unit="s", low=1, high=1e5,
        help="Time in which old frames fade.",
    )  # fmt: skip
    exchange = ProcedureParameter(
        name="exchange", kind="bool", default=True, help="Exchange the matrix on the way."
    )
    effective = gain.model_copy(update={"default": None, "help": "Effective gain; as configured by default."})
    c = config.calibration
    choice = ProcedureParameter(
        name="modes_choice", kind="choice", default=c.modes_choice, choices=MODES_CHOICES,
        help="Which modes SPRINT uses.",
    )  # fmt: skip
    loss = ProcedureParameter(
        name="loss", kind="choice", default=c.loss, choices=LOSSES, help="How much SPRINT trusts each slope."
    )
    declared: list[tuple[str, str, str, tuple[ProcedureParameter, ...], Callable[[Arguments, ProductStore], Task[Any]]]] = [
        ("sprint", "SPRINT", "Find the registration behind a measured matrix; nothing moves.",
         (_MEASURED_IM, _solver_parameter(config), choice, loss), _sprint_task),
        ("loop", "Closed loop", "Close the loop for a number of frames, and judge it.",
         (_IM, _frames_parameter(5000), gain, leak, dropped, best, _STREHL), _loop_task),
        ("gains", "Optical gains", "Close the loop on a matrix and scale it to the turbulence.",
         (_IM, _poke_parameter(0.002), accuracy, budget, _frames_parameter(20000, "Frames per round at most."), effective,
          _STREHL), _gains_task),
        ("track", "Tracker", "Close the loop and follow what drifts.",
         (_IM, seconds, _poke_parameter(t.poke), memory, gain, exchange, _STREHL), _track_task),
        ("sensor", "Find the sensor", "Watch the sensor and find its sub-apertures; the mirror stays flat.",
         (_frames_parameter(SETUP_FRAMES),), lambda arguments, product_store: SensorTask(int(arguments["frames"] or 1))),
        ("model-psf", "Model PSF", "Image without turbulence, which Strehl ratios are measured against.",
         (_frames_parameter(_PSF_FRAMES, "Science frames to average."),),
         lambda arguments, product_store: ModelPsfTask(int(arguments["frames"] or 1))),
    ]  # fmt: skip
    return [
        RegisteredProcedure(
            ProcedureEntry(name=name, title=title, help=help, parameters=parameters), build_task
        )
        for name, title, help, parameters, build_task in declared
    ]


class ProcedureRegistry:
    """What a server of a system offers.

    Parameters
    ----------
    config
        The system, whose values are the defaults.
    """

    def __init__(self, config: SystemConfig) -> None:
        self._procedures = {
            one.name: one for one in (*_calibration_procedures(config), *_other_procedures(config))
        }

    @property
    def entries(self) -> tuple[ProcedureEntry, ...]:
        """All of them, for clients."""
        return tuple(one.entry for one in self._procedures.values())

    def arguments(self, name: str, given: Arguments) -> Arguments:
        """All arguments of a procedure, defaults included.

        Raises
        ------
        ConfigError
            No such procedure, or an argument is wrong.
        """
        return check_arguments(self._look_up(name).entry.parameters, given)

    def task(self, name: str, given: Arguments, product_store: ProductStore) -> Task[Any]:
        """The task that these arguments ask for; a run that goes on keeps its own where none are given.

        Raises
        ------
        ConfigError, ProductError
            They do not go together.
        """
        arguments = self.arguments(name, given)
        if given.get("resume") is not None:
            arguments = {key: value if key in given else None for key, value in arguments.items()}
        return self._look_up(name).build_task(arguments, product_store)

    def _look_up(self, name: str) -> RegisteredProcedure:
        if name not in self._procedures:
            raise ConfigError(f"no procedure is called '{name}'; there are {', '.join(self._procedures)}")
        return self._procedures[name]


def needs_loop(name: str, arguments: Arguments) -> bool:
    """Whether a procedure works in closed loop, so that it cannot be halted between two frames."""
    return name in ("loop", "gains", "track") or arguments.get("closed_loop") is not None
