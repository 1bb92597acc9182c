"""The procedures that a server offers, by the names and with the defaults of the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from escape_hw.calibration.sensor_setup import SETUP_FRAMES
from escape_hw.config.models import ESTIMATORS, LOSSES, MODES_CHOICES, SOLVERS, SystemConfig
from escape_hw.errors import ConfigError, ProductError
from escape_hw.remote.state import Arguments, Parameter, ProcedureEntry
from escape_hw.runtime.calibration_task import CalibrationRequest, CalibrationTask
from escape_hw.runtime.gains_task import GainsTask
from escape_hw.runtime.loop_task import LoopTask
from escape_hw.runtime.procedures import CLOSED_LOOP
from escape_hw.runtime.psf_task import PsfTask
from escape_hw.runtime.sensor_task import SensorTask
from escape_hw.runtime.sprint_task import SprintTask
from escape_hw.runtime.task import Task
from escape_hw.runtime.track_task import TrackTask
from escape_hw.server.arguments import completed
from escape_hw.server.shelf import Shelf

#: Science frames of a model PSF.
_PSF_FRAMES = 20
#: DO-CRIME's pokes, as the configuration names them.
_POKES: tuple[str, ...] = ("white", "shaped", "equal-snr")


@dataclass(frozen=True, slots=True)
class Offer:
    """One procedure.

    Parameters
    ----------
    make
        Makes the task of the arguments.
    """

    entry: ProcedureEntry
    make: Callable[[Arguments, Shelf], Task[Any]]

    @property
    def name(self) -> str:
        """Its name."""
        return self.entry.name


def _frames(default: int, help: str = "Frames to take.") -> Parameter:
    return Parameter(name="frames", kind="int", default=default, unit="frame", low=1, high=1e8, help=help)


def _poke(default: float) -> Parameter:
    return Parameter(
        name="poke", kind="float", default=default, unit="of full stroke", low=1e-6, high=1,
        help="Rms surface of each mode's poke.",
    )  # fmt: skip


_SNR = Parameter(
    name="snr", kind="float", low=0.01, help="Stop when every mode has this signal-to-noise ratio."
)
_IM = Parameter(name="im", kind="matrix", help="Interaction matrix to close the loop with.")
_MEASURED = Parameter(name="im", kind="matrix", help="Interaction matrix that was measured.")
_CLOSED = Parameter(name="closed_loop", kind="matrix", help="Measure in closed loop, with this matrix.")
_RESUME = Parameter(name="resume", kind="text", help="Folder of a run that was broken off, to go on with it.")
_STREHL = Parameter(
    name="strehl", kind="bool", default=True, help="Measure the model PSF and the Strehl ratios."
)


def _gain(config: SystemConfig) -> Parameter:
    return Parameter(
        name="gain", kind="float", default=config.loop.gain, low=0.001, high=2, help="Gain of the loop."
    )


def _solver(config: SystemConfig) -> Parameter:
    return Parameter(
        name="solver", kind="choice", default=config.calibration.solver, choices=SOLVERS,
        help="How SPRINT solves.",
    )  # fmt: skip


def _calibrations(config: SystemConfig) -> list[Offer]:
    c = config.calibration
    accuracy = Parameter(
        name="accuracy", kind="float", unit="% of a sub-aperture", low=1e-6,
        help="Stop when the shifts are known to this.",
    )  # fmt: skip
    estimator = Parameter(
        name="estimator", kind="choice", default=c.estimator, choices=ESTIMATORS, help="What SPRINT fits."
    )
    pokes = Parameter(name="pokes", kind="choice", default=c.pokes, choices=_POKES, help="Kind of pokes.")
    plain = Parameter(
        name="plain", kind="bool", default=False, help="The paper's estimator, turbulence not whitened."
    )
    white = (_frames(c.frames), _poke(c.poke), _SNR)
    each = (_frames(c.push_pull_frames, "Frames per push and per pull."), _poke(c.push_pull_poke), _SNR)
    batch = (_frames(c.modulated_frames, "Frames per batch of modes."), _poke(c.poke), _SNR)
    fast = (_frames(c.frames), _poke(c.push_pull_poke), _SNR, _CLOSED)
    found = [
        ("escape", "ESCAPE", "Pokes under turbulence, SPRINT, pseudo-synthetic matrix.",
         (*white, accuracy, estimator, _solver(config), pokes, _CLOSED)),
        ("docrime", "DO-CRIME", "Interaction matrix by random pokes, under turbulence or not.",
         (*white, pokes, plain, _CLOSED)),
        ("push-pull", "Push-pull", "Interaction matrix mode by mode; needs a source.", each),
        ("push-pull-fast", "Fast push-pull", "Push and pull within two frames.", fast),
        ("modulated", "Modulation", "Several modes at once, each on a frequency of its own.", batch),
    ]  # fmt: skip
    return [
        Offer(
            ProcedureEntry(name=name, title=title, help=help, parameters=(*parameters, _RESUME)),
            _calibration(name),
        )
        for name, title, help, parameters in found
    ]


def _calibration(method: str) -> Callable[[Arguments, Shelf], Task[Any]]:
    def make(arguments: Arguments, shelf: Shelf) -> Task[Any]:
        asked: dict[str, Any] = {"method": method, **arguments}
        settings: dict[str, object] = {key: asked.pop(key, None) for key in ("pokes", "solver")}
        resume = asked.pop("resume")
        closing = asked.pop("closed_loop", None)
        if closing is not None and method in CLOSED_LOOP:
            asked["closed_loop"] = str(shelf.matrix(str(closing)))
        folder = None if resume is None else shelf.allowed(str(resume))
        if folder is not None:
            kept = _kept_settings(folder)
            settings = {key: kept.get(key) if value is None else value for key, value in settings.items()}
        if method != "escape" or settings.get("solver") is None:
            settings.pop("solver")
        return CalibrationTask(CalibrationRequest.of(asked, folder), resume=folder, settings=settings)

    return make


def _kept_settings(folder: Path) -> dict[str, Any]:
    """The section ``calibration`` of the configuration of the run in a folder."""
    path = folder / "config.toml"
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8")).get("calibration", {})
    except (OSError, ValueError) as error:
        raise ProductError(f"{path}: cannot be read ({error}); is {folder} the folder of a run?") from error
    return dict(found)


def _matrix(arguments: Arguments, shelf: Shelf) -> Path:
    name = arguments.pop("im")
    if name is None:
        raise ConfigError("im is missing; name a matrix that the server holds")
    return shelf.matrix(str(name))


def _loop(arguments: Arguments, shelf: Shelf) -> Task[Any]:
    asked: dict[str, Any] = dict(arguments)
    path = _matrix(asked, shelf)
    if asked["best"]:
        asked["gain"] = None
    return LoopTask(path, **asked)


def _gains(arguments: Arguments, shelf: Shelf) -> Task[Any]:
    asked: dict[str, Any] = dict(arguments)
    path = _matrix(asked, shelf)
    return GainsTask(path, strehl=asked.pop("strehl"), options=asked)


def _track(arguments: Arguments, shelf: Shelf) -> Task[Any]:
    asked: dict[str, Any] = dict(arguments)
    return TrackTask(_matrix(asked, shelf), **asked)


def _sprint(arguments: Arguments, shelf: Shelf) -> Task[Any]:
    asked: dict[str, Any] = dict(arguments)
    return SprintTask(_matrix(asked, shelf), settings=asked)


def _others(config: SystemConfig) -> list[Offer]:
    gain, t = _gain(config), config.tracking
    leak = Parameter(
        name="leak", kind="float", default=config.loop.leak, low=0, high=1, help="Leak per frame."
    )
    dropped = Parameter(
        name="dropped_modes", kind="int", default=config.loop.dropped_modes, low=0,
        high=config.basis.n_modes - 1, help="Eigenmodes left out of the reconstructor.",
    )  # fmt: skip
    best = Parameter(name="best", kind="bool", default=False, help="Look for the best gain first.")
    accuracy = Parameter(
        name="accuracy", kind="float", default=0.01, low=1e-5, high=1, help="Relative error of the gains."
    )
    budget = Parameter(
        name="budget", kind="float", default=0.01, low=1e-5, high=1, help="Strehl ratio that pokes may cost."
    )
    seconds = Parameter(
        name="seconds", kind="float", default=60.0, unit="s", low=1, high=1e6, help="How long."
    )
    memory = Parameter(
        name="memory", kind="float", default=t.memory_s, unit="s", low=1, high=1e5,
        help="Time in which old frames fade.",
    )  # fmt: skip
    exchange = Parameter(name="exchange", kind="bool", default=True, help="Exchange the matrix on the way.")
    effective = gain.model_copy(update={"default": None, "help": "Effective gain; as configured by default."})
    c = config.calibration
    choice = Parameter(
        name="modes_choice", kind="choice", default=c.modes_choice, choices=MODES_CHOICES,
        help="Which modes SPRINT uses.",
    )  # fmt: skip
    loss = Parameter(
        name="loss", kind="choice", default=c.loss, choices=LOSSES, help="How much SPRINT trusts each slope."
    )
    found: list[tuple[str, str, str, tuple[Parameter, ...], Callable[[Arguments, Shelf], Task[Any]]]] = [
        ("sprint", "SPRINT", "Find the registration behind a measured matrix; nothing moves.",
         (_MEASURED, _solver(config), choice, loss), _sprint),
        ("loop", "Closed loop", "Close the loop for a number of frames, and judge it.",
         (_IM, _frames(5000), gain, leak, dropped, best, _STREHL), _loop),
        ("gains", "Optical gains", "Close the loop on a matrix and scale it to the turbulence.",
         (_IM, _poke(0.002), accuracy, budget, _frames(20000, "Frames per round at most."), effective,
          _STREHL), _gains),
        ("track", "Tracker", "Close the loop and follow what drifts.",
         (_IM, seconds, _poke(t.poke), memory, gain, exchange, _STREHL), _track),
        ("sensor", "Find the sensor", "Watch the sensor and find its sub-apertures; the mirror stays flat.",
         (_frames(SETUP_FRAMES),), lambda arguments, shelf: SensorTask(int(arguments["frames"] or 1))),
        ("model-psf", "Model PSF", "Image without turbulence, which Strehl ratios are measured against.",
         (_frames(_PSF_FRAMES, "Science frames to average."),),
         lambda arguments, shelf: PsfTask(int(arguments["frames"] or 1))),
    ]  # fmt: skip
    return [
        Offer(ProcedureEntry(name=name, title=title, help=help, parameters=parameters), make)
        for name, title, help, parameters, make in found
    ]


class Offers:
    """What a server of a system offers.

    Parameters
    ----------
    config
        The system, whose values are the defaults.
    """

    def __init__(self, config: SystemConfig) -> None:
        self._offers = {one.name: one for one in (*_calibrations(config), *_others(config))}

    @property
    def entries(self) -> tuple[ProcedureEntry, ...]:
        """All of them, for clients."""
        return tuple(one.entry for one in self._offers.values())

    def arguments(self, name: str, given: Arguments) -> Arguments:
        """All arguments of a procedure, defaults included.

        Raises
        ------
        ConfigError
            No such procedure, or an argument is wrong.
        """
        return completed(self._known(name).entry.parameters, given)

    def task(self, name: str, given: Arguments, shelf: Shelf) -> Task[Any]:
        """The task that these arguments ask for; a run that goes on keeps its own where none are given.

        Raises
        ------
        ConfigError, ProductError
            They do not go together.
        """
        arguments = self.arguments(name, given)
        if given.get("resume") is not None:
            arguments = {key: value if key in given else None for key, value in arguments.items()}
        return self._known(name).make(arguments, shelf)

    def _known(self, name: str) -> Offer:
        if name not in self._offers:
            raise ConfigError(f"no procedure is called '{name}'; there are {', '.join(self._offers)}")
        return self._offers[name]


def needs_loop(name: str, arguments: Arguments) -> bool:
    """Whether a procedure works in closed loop, so that it cannot be halted between two frames."""
    return name in ("loop", "gains", "track") or arguments.get("closed_loop") is not None
