"""Declaration of a procedure: one class with its typed parameters and its behaviour.

The command line, the server's registry, the window's form, the client and the Python methods are derived
from these classes. Importing a declaration loads no numerical library: heavy imports stay inside methods.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Self,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from escape_hw.config.renamed import present_value
from escape_hw.deprecation import renamed_text, warn_renamed
from escape_hw.errors import ConfigError
from escape_hw.suggestions import closest_match

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


ResultT = TypeVar("ResultT")
_KINDS = {bool: "bool", int: "int", float: "float", str: "text"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a procedure; declared with :func:`parameter`.

    Parameters
    ----------
    name
        Name on every interface; the option of the command line has dashes instead of underscores.
    kind
        ``int``, ``float``, ``bool``, ``choice``, ``choices`` (several, separated by commas), ``text``,
        ``matrix`` (file of an interaction matrix, on the server the name of a product), ``matrices`` or
        ``run`` (folder of an earlier run).
    default
        Value if absent. ``None``: the value of ``config_key`` or, without a key, no value.
    help, label
        One sentence for every interface, and words for the window's form (the name by default).
    unit, low, high
        Unit, smallest and largest value of a number.
    choices
        The possible values of a text.
    config_key
        Key of the system's configuration whose value is the default, such as ``"loop.gain"``.
    sets_config
        A given value replaces the value of ``config_key`` in the configuration of the run.
    on_server
        Whether a server offers the parameter.
    last
        List the parameter after those of derived classes.
    deprecated, deprecated_inverse
        Names of earlier versions; the latter belong to booleans of the opposite meaning.
    """

    name: str
    kind: str
    default: Any = None
    required: bool = False
    help: str = ""
    label: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    config_key: str = ""
    sets_config: bool = False
    on_server: bool = True
    last: bool = False
    deprecated: tuple[str, ...] = ()
    deprecated_inverse: tuple[str, ...] = ()

    def check(self, value: Any, label: str = "") -> Any:
        """The value, converted to the type of the parameter; ``None`` if the parameter is absent.

        Messages call the parameter ``label``, by default its name.

        Raises
        ------
        ConfigError
            The value has the wrong type, is out of range or not one of the choices.
        """
        label = label or self.name
        if value is None:
            if self.required:
                raise ConfigError(f"{label} is missing; {self.help[:1].lower()}{self.help[1:]}")
            return None
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise ConfigError(f"{label} is {value!r}; it must be true or false")
            return value
        if self.kind in ("int", "float"):
            return self._check_number(value, label)
        if self.kind in ("matrix", "matrices", "run"):
            return self._check_path(value, label)
        if not isinstance(value, str):
            raise ConfigError(f"{label} is {value!r}; it must be text")
        words = (
            [word.strip() for word in value.split(",") if word.strip()] if self.kind == "choices" else [value]
        )
        words = [present_value(self.config_key, word) for word in words]
        for word in words if self.choices else ():
            if word not in self.choices:
                raise ConfigError(f"{label} is '{word}'; it is one of {', '.join(self.choices)}")
        return ",".join(words)

    def _check_path(self, value: Any, label: str) -> Any:
        if self.kind == "matrices" and not isinstance(value, str | Path):
            return tuple(Path(path) for path in value)
        if not isinstance(value, str | Path):
            raise ConfigError(f"{label} is {value!r}; it must be text")
        return Path(value)

    def _check_number(self, value: Any, label: str) -> float | int:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"{label} is {value!r}; it must be a number")
        if self.kind == "int" and value != int(value):
            raise ConfigError(f"{label} is {value!r}; it must be a whole number")
        if (self.low is not None and value < self.low) or (self.high is not None and value > self.high):
            unit = f" {self.unit}" if self.unit else ""
            least = "" if self.low is None else f"at least {self.low:g}"
            most = "" if self.high is None else f"at most {self.high:g}"
            raise ConfigError(
                f"{label} is {value:g}; it must be {' and '.join(filter(None, (least, most)))}{unit}"
            )
        return int(value) if self.kind == "int" else float(value)


def parameter(*, default: Any = dataclasses.MISSING, kind: str = "", **attributes: Any) -> Any:
    """Declare a parameter in the body of a :class:`ProcedureSpec`; without a default it is required.

    The attributes are those of :class:`Parameter`. ``kind`` is needed if the annotation does not give it.
    """
    required = default is dataclasses.MISSING
    declared = Parameter("", kind, None if required else default, required, **attributes)
    return field(default=default, metadata={"parameter": declared})


@dataclass(frozen=True, slots=True)
class SavedRun:
    """Content of ``result.json``, with absolute paths, and whether the run met its own criteria."""

    document: dict[str, Any] = field(default_factory=dict)
    met: bool = True


@dataclass_transform(kw_only_default=True, eq_default=False, field_specifiers=(parameter,))
class ProcedureSpec(ABC, Generic[ResultT]):
    """Base class of the procedures. An instance is one request, with a value for every parameter.

    A derived class declares its parameters as annotated attributes with :func:`parameter`, sets ``name``,
    ``title`` and ``help``, and defines :meth:`procedure` and :meth:`save`. It becomes a dataclass whose
    arguments are given by keyword. The methods are called in the order :meth:`load`, :meth:`procedure`,
    :meth:`save`, :meth:`finish`.

    Raises
    ------
    ConfigError
        A value is out of range, or values exclude each other.
    """

    #: Name of the command and of the server's procedure.
    name: ClassVar[str] = ""
    #: Heading in the window.
    title: ClassVar[str] = ""
    #: One sentence on what the procedure does.
    help: ClassVar[str] = ""
    #: Whether the procedure closes the loop; it cannot then be paused between two frames.
    closes_loop: ClassVar[bool] = False
    #: Whether random pokes of all modes are superposed in every frame.
    random_pokes: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        dataclass(kw_only=True, eq=False)(cls)

    def __post_init__(self) -> None:
        for one in self.parameters():
            setattr(self, one.name, one.check(getattr(self, one.name)))
        self.validate()

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """The parameters, in the order in which forms and help list them."""
        hints = get_type_hints(cls)
        found = []
        for each in dataclasses.fields(cls):  # type: ignore[arg-type]
            declared: Parameter = each.metadata["parameter"]
            kind = declared.kind or ("choice" if declared.choices else _kind_of(hints[each.name]))
            found.append(dataclasses.replace(declared, name=each.name, kind=kind))
        return tuple(sorted(found, key=lambda one: one.last))

    @classmethod
    def from_arguments(cls, arguments: Mapping[str, Any], label: Callable[[str], str] = str) -> Self:
        """A request from arguments by name; see :func:`check_arguments`.

        Raises
        ------
        ConfigError
            Names all arguments that are unknown or wrong.
        """
        return cls(**check_arguments(cls.parameters(), arguments, label))

    @property
    def kind(self) -> str:
        """Part of the run folder's name."""
        return self.name

    @property
    def overrides(self) -> tuple[str, ...]:
        """Changes to the system's configuration for this run, ``section.key=value`` each."""
        changes = []
        for one in self.parameters():
            value = getattr(self, one.name)
            if one.sets_config and value is not None:
                value = list(filter(None, value.split(","))) if one.kind == "choices" else value
                changes.append(f"{one.config_key}={value}")
        return tuple(changes)

    @classmethod
    def works_in_closed_loop(cls, arguments: Mapping[str, Any]) -> bool:
        """Whether the loop is closed during a run with these arguments."""
        return cls.closes_loop or arguments.get("closed_loop") is not None

    @classmethod
    def preparation_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames that a run takes before it measures, and does not count in its result."""
        return 0

    @classmethod
    def planned_frames(cls, bench: Bench, arguments: Mapping[str, Any]) -> int:
        """Sensor frames that a run takes, with those of its preparation; ``arguments`` are complete."""
        return cls.preparation_frames(bench, arguments) + int(arguments.get("frames") or 0)

    def validate(self) -> None:
        """Check values that depend on each other.

        Raises
        ------
        ConfigError
            They exclude each other.
        """

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """Read the files that the run needs, before any device is opened.

        ``simulated``: the devices are open already and simulated, whatever the configured mode is.

        Raises
        ------
        ConfigError
            The configuration does not allow the run.
        ProductError, IncompatibleProduct
            A file is damaged, or belongs to another system.
        """

    def require_first(self, config: SystemConfig) -> None:
        """Check, before any device is opened, what a procedure needs that is the first on a new bench.

        Raises
        ------
        ConfigError
            It needs the result of another procedure, which the configuration does not name.
        """

    @abstractmethod
    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[ResultT]:
        """The generator that does the work, on an open bench with the configuration given to :meth:`load`.

        Intermediate files go to ``folder``; without one the run leaves none.

        Raises
        ------
        IncompatibleProduct
            A simulated matrix on hardware.
        """

    @abstractmethod
    def save(self, folder: RunFolder, record: BenchRecord, result: ResultT, wall_seconds: float) -> SavedRun:
        """Save a complete or partial result with its report.

        Raises
        ------
        StorageError
            A file cannot be written.
        """

    def finish(self) -> None:
        """Remove files that are only needed to resume an incomplete run."""

    def on_bench(self, bench: Bench) -> Procedure[ResultT]:
        """Run on an open bench without a run folder; nothing is saved.

        Raises
        ------
        ConfigError, ProductError, IncompatibleProduct
            See :meth:`load` and :meth:`procedure`.
        """
        from escape_hw.config.loader import load_text

        before = bench.config
        config = load_text(before.to_toml(), overrides=self.overrides) if self.overrides else before
        self.load(config, bool(bench.simulated))
        bench.config = config
        try:
            return (yield from self.procedure(bench, None))
        finally:
            bench.config = before


class ComputedProcedure(ProcedureSpec[ResultT]):
    """A procedure that computes from saved products; the command line opens no device for it."""

    @abstractmethod
    def compute(self) -> Procedure[ResultT]:
        """The generator that does the work."""

    @abstractmethod
    def save_computed(self, folder: RunFolder, result: ResultT, wall_seconds: float) -> SavedRun:
        """Save the result with its report."""

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[ResultT]:
        """The generator that does the work; the bench is not used."""
        return self.compute()

    def save(self, folder: RunFolder, record: BenchRecord, result: ResultT, wall_seconds: float) -> SavedRun:
        """Save the result; it does not depend on the state of the bench."""
        return self.save_computed(folder, result, wall_seconds)


def _kind_of(hint: Any) -> str:
    types = [each for each in get_args(hint) if each is not NoneType] if get_args(hint) else [hint]
    if len(types) != 1 or get_origin(hint) is tuple or types[0] not in _KINDS:
        raise TypeError(f"{hint} needs an explicit kind: parameter(kind=...)")
    return _KINDS[types[0]]


def present_names(
    parameters: Iterable[Parameter], arguments: Mapping[str, Any], label: Callable[[str], str] = str
) -> dict[str, Any]:
    """Arguments under their present names, with a deprecation warning for each name of an earlier version."""
    present = dict(arguments)
    for one in parameters:
        for old in (*one.deprecated, *one.deprecated_inverse):
            if (value := present.pop(old, None)) is None:
                continue
            inverse = old in one.deprecated_inverse and isinstance(value, bool)
            opposite = " (with the opposite meaning)" if inverse else ""
            warn_renamed(renamed_text(label(old), f"{label(one.name)}{opposite}"))
            if present.get(one.name) is None:
                present[one.name] = not value if inverse else value
    return present


def check_arguments(
    parameters: Iterable[Parameter], arguments: Mapping[str, Any], label: Callable[[str], str] = str
) -> dict[str, Any]:
    """A value for every parameter: the one given, or the default.

    Arguments may have names of earlier versions; ``None`` stands for absent. ``label`` spells the name of a
    parameter for messages.

    Raises
    ------
    ConfigError
        Names all arguments that are unknown, missing, of the wrong type or out of range.
    """
    known = {one.name: one for one in parameters}
    given = present_names(known.values(), arguments, label)
    wrong = [_unknown_message(name, known, label) for name in given if name not in known]
    values = {}
    for name, one in known.items():
        value = given.get(name)
        try:
            values[name] = one.check(one.default if value is None else value, label(name))
        except ConfigError as error:
            wrong.append(str(error))
    if wrong:
        raise ConfigError("; ".join(wrong))
    return values


def _unknown_message(name: str, known: Iterable[str], label: Callable[[str], str]) -> str:
    near = closest_match(name, known)
    names = ", ".join(map(label, known)) or "none"
    hint = f"did you mean '{label(near)}'?" if near else f"there are {names}"
    return f"'{label(name)}' is no argument of this procedure; {hint}"
