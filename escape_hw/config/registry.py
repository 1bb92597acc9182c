"""Registry of entry points: drivers, twins, synthetic models, emulators, simulated benches, windows."""

from __future__ import annotations

import contextlib
import importlib.metadata
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

from escape_hw.api.device import Device
from escape_hw.api.emulator import EmulatorFactory, StandInBenchFactory
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.system import SystemConfig
from escape_hw.deprecation import warn_renamed
from escape_hw.errors import ConfigError, EscapeError, raised_at
from escape_hw.suggestions import closest_match

T = TypeVar("T")


def require_factory(what: str, where: str, factory: object, parameters: Sequence[str]) -> None:
    """Check that an object can be called as a factory with positional arguments of these names.

    ``what`` and ``where`` describe the object in the message.

    Raises
    ------
    ConfigError
        The object is not callable or takes other arguments.
    """
    call = f"factory({', '.join(parameters)})"
    if not callable(factory):
        raise ConfigError(
            f"{what} is broken: {where} is not callable (it is of type {type(factory).__name__}); {call} is "
            "expected"
        )
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        # Some compiled functions have no signature.
        return
    try:
        signature.bind(*parameters)
    except TypeError as error:
        raise ConfigError(
            f"{what} is broken: {where} takes {signature} ({error}); it is called as {call}"
        ) from error


def call_factory(what: str, kind: type[T], factory: Callable[..., object], *arguments: Any) -> T:
    """Call a factory and check the type of its result; ``what`` describes it in messages.

    Raises
    ------
    ConfigError
        The factory fails or returns another type.
    EscapeError
        Raised by the factory itself.
    """
    try:
        product = factory(*arguments)
    except EscapeError:
        raise
    except Exception as error:
        raise ConfigError(
            f"{what} cannot be created: {_factory_name(factory)} failed with {type(error).__name__}: {error}"
            f"{raised_at(error)}"
        ) from error
    if not isinstance(product, kind):
        wrong = f"{what} creates a {type(product).__name__}, not a {kind.__name__}"
        if isinstance(product, Device) and issubclass(kind, Device):
            raise ConfigError(f"{wrong}{_suggest_drivers(kind)}")
        raise ConfigError(f"{wrong}; {_factory_name(factory)} must return one")
    return product


def drivers_of(kind: type[Device]) -> list[str]:
    """The installed drivers that create devices of a class, for messages."""
    names = []
    for name in available(DEVICES):
        with contextlib.suppress(ConfigError):
            # A driver that is not completely installed, or part of a system only, is no way out.
            names += [name] if issubclass(device_class(name), kind) else []
    return names


def _suggest_drivers(kind: type[Device]) -> str:
    names = drivers_of(kind)
    return f"; drivers that do: {', '.join(names)}" if names else ""


def explain_missing_driver(kind: type[Device]) -> str:
    """What a system without a driver for a device of this class needs, for messages."""
    names = drivers_of(kind)
    known = f" ({', '.join(names)})" if names else ""
    return f"name one{known}"


def _factory_name(factory: object) -> str:
    factory = factory.func if isinstance(factory, partial) else factory
    module, name = (getattr(factory, key, "") for key in ("__module__", "__qualname__"))
    return f"{module}:{name}" if module and name else repr(factory)


DEVICES = "escape.devices"
MODELS = "escape.models"
EMULATORS = "escape.emulators"
STAND_INS = "escape.stand_ins"
WINDOWS = "escape.windows"
_KINDS = {
    DEVICES: "device driver",
    MODELS: "synthetic model",
    EMULATORS: "emulator",
    STAND_INS: "simulated bench",
    WINDOWS: "window",
}
#: Arguments of the factories of each group.
_PARAMETERS = {
    DEVICES: ("section", "context"),
    MODELS: ("config", "grid"),
    EMULATORS: ("request",),
    STAND_INS: ("config",),
    WINDOWS: ("system", "address", "screenshot", "reset_settings"),
}
#: Prefix of the names of twins; other drivers are for real hardware.
TWIN_PREFIX = "sim-"


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """What a device is part of; second argument of every factory.

    Parameters
    ----------
    name
        Key of the device in ``[devices]``, used in messages.
    system
        Configuration of the system; ``None`` for a device opened alone.
    shared
        One dictionary for each opened system, which the twins of a bench share.
    """

    name: str
    system: SystemConfig | None = None
    shared: dict[str, object] = field(default_factory=dict)

    def require_system(self) -> SystemConfig:
        """The configuration of the system; raises ``ConfigError`` for a device opened alone."""
        if self.system is None:
            raise ConfigError(f"{self.name}: is part of a system and cannot be opened alone; open the system")
        return self.system


#: ``factory(section, context) -> device``: the device's own section of ``[devices]`` and its context.
DeviceFactory = Callable[[Any, DeviceContext], Device]
#: ``factory(config, grid) -> model``; without a grid the model uses the nominal one.
ModelFactory = Callable[[SystemConfig, SensorGeometry | None], SyntheticModel]
#: ``run(system, address, screenshot, reset_settings) -> exit code``: shows the window until it is closed.
WindowRunner = Callable[[str, str, Path | None, bool], int]
#: Drivers that a script registered for its own process.
_REGISTERED: dict[str, DeviceFactory | type[Device]] = {}


def register_device(name: str, factory: DeviceFactory | type[Device]) -> None:
    """Register a driver or twin in this process, for scripts and notebooks.

    A package declares an entry point in the group ``escape.devices`` instead. Registering a name again
    replaces the factory.

    Parameters
    ----------
    name
        Value of ``driver`` or ``sim_driver`` in a device section.
    factory
        A class of devices with ``from_section(section, context)``, or a function
        ``factory(section, context)`` that returns a device that is not open, see :data:`DeviceFactory`.

    Raises
    ------
    ConfigError
        An installed package provides this name, or the factory is not callable with these arguments.
    """
    _as_device_factory(f"device driver '{name}'", repr(factory), factory)
    if any(entry.name == name for entry in importlib.metadata.entry_points(group=DEVICES)):
        raise ConfigError(f"device driver '{name}' is provided by an installed package; choose another name")
    _REGISTERED[name] = factory


def available(group: str) -> tuple[str, ...]:
    """Sorted names of a group (:data:`DEVICES`, :data:`MODELS`, :data:`EMULATORS`)."""
    own = _REGISTERED if group == DEVICES else ()
    return tuple(sorted({*own, *(entry.name for entry in importlib.metadata.entry_points(group=group))}))


def device_factory(name: str, *, hardware: bool = False) -> DeviceFactory:
    """The factory of a driver or twin; with ``hardware``, messages suggest no twins.

    Raises
    ------
    ConfigError
        Unknown name (the message gives the closest one), or its package is not completely installed.
    """
    return _as_device_factory(*_find_device(name, hardware))


def device_class(name: str, kind: type[Device] = Device) -> type[Device]:
    """The class of a driver that can be opened without a system: its keywords are the driver's own.

    Raises
    ------
    ConfigError
        As :func:`device_factory`, the driver works as a part of a system only, or creates no ``kind``.
    """
    *_, found = _find_device(name, hardware=not name.startswith(TWIN_PREFIX))
    if isinstance(found, type) and issubclass(found, Device):
        if issubclass(found, kind):
            return found
        raise ConfigError(
            f"driver '{name}' creates a {found.__name__}, not a {kind.__name__}{_suggest_drivers(kind)}"
        )
    raise ConfigError(
        f"device driver '{name}' works as a part of a system only; open the system (open_system, or its name "
        "in place of --driver)"
    )


def _find_device(name: str, hardware: bool) -> tuple[str, str, Any]:
    """Name of a driver for messages, where it is, and what is there: a class of devices or a function."""
    if name in _REGISTERED:
        return f"device driver '{name}'", repr(_REGISTERED[name]), _REGISTERED[name]
    entry = _find_entry(DEVICES, name, hardware)
    return f"device driver '{name}' of {_package(entry)}", entry.value, _load_entry(_KINDS[DEVICES], entry)


def _as_device_factory(what: str, where: str, found: Any) -> DeviceFactory:
    """A class or function as a factory; functions ``(name, config, shared)`` of version 0.1.0 are wrapped."""
    if isinstance(found, type) and issubclass(found, Device):
        factory = getattr(found, "from_section", None)
        if factory is None:
            raise ConfigError(
                f"{what} is broken: {where} has no class method from_section(section, context); add it"
            )
        return cast(DeviceFactory, factory)
    if _takes_three(found):
        warn_renamed(
            f"{what}: {where} takes (name, config, shared); since version 0.2.0 factories take (section, "
            "context), where context has name, system and shared; version 0.3.0 removes the old form"
        )
        return lambda section, context: found(context.name, context.require_system(), context.shared)
    require_factory(what, where, found, _PARAMETERS[DEVICES])
    return cast(DeviceFactory, found)


def _takes_three(found: Any) -> bool:
    """Whether a function has the three parameters of version 0.1.0."""
    try:
        signature = inspect.signature(found)
        signature.bind("name", "config", "shared")
    except (TypeError, ValueError):
        return False
    try:
        signature.bind("section", "context")
    except TypeError:
        return True
    return next(iter(signature.parameters)) == "name"


def model_factory(name: str) -> ModelFactory:
    """The factory of a synthetic model, with its result checked. Raises as :func:`device_factory`."""
    return cast(
        ModelFactory, partial(call_factory, f"synthetic model '{name}'", SyntheticModel, _load(MODELS, name))
    )


def emulator_factory(name: str) -> EmulatorFactory:
    """The factory of an emulator. Raises as :func:`device_factory`."""
    return cast(EmulatorFactory, _load(EMULATORS, name))


def stand_in_bench_factory() -> StandInBenchFactory:
    """The factory of the simulated bench behind real drivers. Raises as :func:`device_factory`."""
    return cast(StandInBenchFactory, _load(STAND_INS, "bench"))


def window_runner() -> WindowRunner:
    """The function that shows the graphical interface. Raises as :func:`device_factory`."""
    return cast(WindowRunner, _load(WINDOWS, "gui"))


def _load(group: str, name: str) -> Any:
    entry = _find_entry(group, name)
    factory = _load_entry(_KINDS[group], entry)
    what = f"{_KINDS[group]} '{name}' of {_package(entry)}"
    require_factory(what, entry.value, factory, _PARAMETERS[group])
    return factory


@lru_cache(maxsize=32)
def _installed(group: str, path: tuple[str, ...]) -> tuple[importlib.metadata.EntryPoint, ...]:
    """Entry points of a group in the packages on a search path; finding them reads a file of each package."""
    return tuple(importlib.metadata.entry_points(group=group))


def _named(group: str, name: str) -> dict[str, importlib.metadata.EntryPoint]:
    """Entry points of a name by their value."""
    return {one.value: one for one in _installed(group, tuple(sys.path)) if one.name == name}


def _find_entry(group: str, name: str, hardware: bool = False) -> importlib.metadata.EntryPoint:
    entries = _named(group, name)
    if not entries:
        # Perhaps installed since they were read.
        _installed.cache_clear()
        entries = _named(group, name)
    if not entries:
        raise ConfigError(_unknown_name_message(group, name, hardware))
    if len(entries) > 1:
        owners = " and ".join(f"{value} ({_package(entry)})" for value, entry in sorted(entries.items()))
        raise ConfigError(
            f"{_KINDS[group]} '{name}' is provided twice: {owners}; uninstall one of the packages"
        )
    (entry,) = entries.values()
    return entry


def _load_entry(kind: str, entry: importlib.metadata.EntryPoint) -> Any:
    try:
        return entry.load()
    except ImportError as error:
        raise ConfigError(_missing_module_message(kind, entry, error)) from error
    except AttributeError as error:
        raise ConfigError(
            f"{kind} '{entry.name}' of {_package(entry)} is broken: {entry.value} does not exist ({error})"
        ) from error


def _unknown_name_message(group: str, name: str, hardware: bool) -> str:
    kind, known = _KINDS[group], available(group)
    none = "none: is escape-hw itself installed in this environment?"
    install = f"install the package that provides it as an entry point in '{group}'"
    if hardware:
        known = tuple(driver for driver in known if not driver.startswith(TWIN_PREFIX))
        kind, none = "driver for real hardware", "none, only twins"
    suggestion = closest_match(name, known)
    hint = f"did you mean '{suggestion}'? " if suggestion else ""
    return f"no {kind} '{name}' is installed ({hint}installed: {', '.join(known) or none}); {install}"


def _missing_module_message(kind: str, entry: importlib.metadata.EntryPoint, error: ImportError) -> str:
    package = _package(entry)
    missing = (error.name or "").partition(".")[0]
    if not missing:
        return f"{kind} '{entry.name}' of {package} cannot be loaded: {error}"
    if missing == entry.module.partition(".")[0]:
        return (
            f"{kind} '{entry.name}': its module {entry.module} is not installed ({error}); "
            f"install it again with: pip install --force-reinstall {package}"
        )
    wanted = f"{package}[{','.join(entry.extras)}]" if entry.extras else missing
    return (
        f"{kind} '{entry.name}' of {package} needs the Python module '{missing}', which is not "
        f"installed; install it with: pip install '{wanted}'"
    )


def _package(entry: importlib.metadata.EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.module.partition(".")[0]
