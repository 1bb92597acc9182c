"""Registry of entry points: drivers, twins, synthetic models, emulators, simulated benches, windows."""

from __future__ import annotations

import importlib.metadata
import inspect
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

from escape_hw.api.device import Device
from escape_hw.api.emulator import EmulatorFactory, StandInBenchFactory
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.key_tree import closest_match
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, EscapeError

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
            f"{_raised_at(error)}"
        ) from error
    if not isinstance(product, kind):
        raise ConfigError(
            f"{what} creates a {type(product).__name__}, not a {kind.__name__}; "
            f"{_factory_name(factory)} must return one"
        )
    return product


def _factory_name(factory: object) -> str:
    module, name = (getattr(factory, key, "") for key in ("__module__", "__qualname__"))
    return f"{module}:{name}" if module and name else repr(factory)


def _raised_at(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""


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
    DEVICES: ("name", "config", "shared"),
    MODELS: ("config", "grid"),
    EMULATORS: ("request",),
    STAND_INS: ("config",),
    WINDOWS: ("system", "address", "screenshot", "reset_settings"),
}
#: Prefix of the names of twins; other drivers are for real hardware.
TWIN_PREFIX = "sim-"

#: ``factory(name, config, shared) -> device``: the key in ``[devices]``, the whole configuration and
#: one dictionary per opened system, which the twins of a bench share.
DeviceFactory = Callable[[str, SystemConfig, dict[str, object]], Device]
#: ``factory(config, grid) -> model``; without a grid the model uses the nominal one.
ModelFactory = Callable[[SystemConfig, SensorGeometry | None], SyntheticModel]
#: ``run(system, address, screenshot, reset_settings) -> exit code``: shows the window until it is closed.
WindowRunner = Callable[[str, str, Path | None, bool], int]
#: Drivers that a script registered for its own process.
_REGISTERED: dict[str, DeviceFactory] = {}


def register_device(name: str, factory: DeviceFactory) -> None:
    """Register a driver or twin in this process, for scripts and notebooks.

    A package declares an entry point in the group ``escape.devices`` instead. Registering a name again
    replaces the factory.

    Parameters
    ----------
    name
        Value of ``driver`` or ``sim_driver`` in a device section.
    factory
        ``factory(name, config, shared)`` returns a device that is not open, see :data:`DeviceFactory`.

    Raises
    ------
    ConfigError
        An installed package provides this name, or the factory is not callable with these arguments.
    """
    require_factory(f"device driver '{name}'", repr(factory), factory, _PARAMETERS[DEVICES])
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
    return _REGISTERED[name] if name in _REGISTERED else cast(DeviceFactory, _load(DEVICES, name, hardware))


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


def _load(group: str, name: str, hardware: bool = False) -> Any:
    kind = _KINDS[group]
    entries = {
        entry.value: entry for entry in importlib.metadata.entry_points(group=group) if entry.name == name
    }
    if not entries:
        raise ConfigError(_unknown_name_message(group, name, hardware))
    if len(entries) > 1:
        owners = " and ".join(f"{value} ({_package(entry)})" for value, entry in sorted(entries.items()))
        raise ConfigError(f"{kind} '{name}' is provided twice: {owners}; uninstall one of the packages")
    (entry,) = entries.values()
    try:
        factory = entry.load()
    except ImportError as error:
        raise ConfigError(_missing_module_message(kind, entry, error)) from error
    except AttributeError as error:
        raise ConfigError(
            f"{kind} '{name}' of {_package(entry)} is broken: {entry.value} does not exist ({error})"
        ) from error
    require_factory(f"{kind} '{name}' of {_package(entry)}", entry.value, factory, _PARAMETERS[group])
    return factory


def _unknown_name_message(group: str, name: str, hardware: bool) -> str:
    kind, known = _KINDS[group], available(group)
    none = "none: is escape-hw itself installed in this environment?"
    install = f"install the package that provides it as an entry point in '{group}'"
    if hardware:
        known = tuple(driver for driver in known if not driver.startswith(TWIN_PREFIX))
        kind, none = "driver for real hardware", "none, only twins"
        install += ", or use the twin (--mode sim)"
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
