"""The devices of a system, opened and closed together; each is its twin or its driver, by ``mode``."""

from __future__ import annotations

import inspect
import logging
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.callbacks import Callbacks, guarded_callback
from escape_hw.api.camera import Camera
from escape_hw.api.concurrency import limit_to_one_thread
from escape_hw.api.device import Device
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import TipTiltModulator
from escape_hw.api.phase_screen import PhaseScreen
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.devices import (
    CameraConfig,
    CameraOrientation,
    DeviceConfig,
    MirrorConfig,
    MirrorOrientation,
    SensorCameraConfig,
    hardware_order,
)
from escape_hw.config.options import parse_limits, parse_options
from escape_hw.config.registry import (
    DeviceContext,
    call_factory,
    device_class,
    device_factory,
    explain_missing_driver,
    model_factory,
)
from escape_hw.config.section import Section
from escape_hw.config.system import SystemConfig
from escape_hw.deprecation import renamed_members
from escape_hw.errors import ConfigError, NotOpen, ProductError
from escape_hw.safety.limits import nearest_pairs

if TYPE_CHECKING:
    from threadpoolctl import _ThreadpoolLimiter

log = logging.getLogger(__name__)

D = TypeVar("D", bound=Device)


@renamed_members(taps="callbacks")
class Bench:
    """The devices and the configuration of a system; a context manager.

    Nothing is connected before :meth:`open`. Devices open in the order mirror, sensor camera, modulator,
    science camera, screen, and close in reverse, so that the mirror is flattened last.

    Parameters
    ----------
    config
        The whole configuration.
    dm, wfs
        Deformable mirror and camera of the wavefront sensor.
    science, screen, modulator
        Science camera, phase screens and modulator of a pyramid; ``None`` if the system has none.

    Attributes
    ----------
    rng
        Random generator of the procedures, seeded from ``system.seed`` and independent of the generators that
        a twin derives from the same seed.
    dark
        Dark frame of the sensor's camera in counts ``(rows, columns)``, or ``None``.
    flat
        Relative response of its pixels ``(rows, columns)``, of mean 1, or ``None``.
    """

    def __init__(
        self,
        config: SystemConfig,
        dm: DeformableMirror,
        wfs: Camera,
        science: Camera | None = None,
        screen: PhaseScreen | None = None,
        modulator: TipTiltModulator | None = None,
    ) -> None:
        self.config = config
        self.dm, self.wfs, self.science, self.screen = dm, wfs, science, screen
        self.modulator = modulator
        self.dark: NDArray[np.float32] | None = None
        self.flat: NDArray[np.float32] | None = None
        self._callbacks = Callbacks()
        self._threads: _ThreadpoolLimiter | None = None
        stream = zlib.crc32(b"escape_hw.bench")
        self.rng = np.random.default_rng(np.random.SeedSequence(config.system.seed, spawn_key=(stream,)))

    @classmethod
    def from_config(cls, config: SystemConfig) -> Self:
        """Build all devices from the registry; opens nothing.

        Raises
        ------
        ConfigError
            A driver or twin is unknown, not installed, or of the wrong kind; or the dark frame or flat of the
            sensor's camera cannot be read, or is of another region.
        """
        shared: dict[str, object] = {}
        devices = config.devices
        dm = _build("dm", devices.dm, config, shared, DeformableMirror)  # type: ignore[type-abstract]
        wfs = _build("wfs", devices.wfs, config, shared, Camera)  # type: ignore[type-abstract]
        science = _build("science", devices.science, config, shared, Camera)  # type: ignore[type-abstract]
        screen = _build("screen", devices.screen, config, shared, PhaseScreen)  # type: ignore[type-abstract]
        modulator = _build("modulator", devices.modulator, config, shared, TipTiltModulator)  # type: ignore[type-abstract]
        if dm is None or wfs is None:
            name, mode = ("dm", devices.dm.mode) if dm is None else ("wfs", devices.wfs.mode)
            key = "sim_driver" if (mode or config.system.mode) == "sim" else "driver"
            remedy = explain_missing_driver(DeformableMirror if dm is None else Camera)
            raise ConfigError(
                f"devices.{name}.{key}: ''  names no driver; every system needs this device: {remedy}"
            )
        bench = cls(config, dm, wfs, science, screen, modulator)
        bench.dark = _read_pixels(devices.wfs, "dark_file")
        bench.flat = _read_pixels(devices.wfs, "flat_file")
        return bench

    def __repr__(self) -> str:
        kind = "simulated" if self.simulated else "hardware"
        state = "open" if self.is_open else "closed"
        return f"<{type(self).__name__} {self.config.system.name}, {kind}, {state}>"

    @property
    def callbacks(self) -> Callbacks:
        """Callbacks for frames, slopes and commands; none by default.

        A callback that raises an exception is removed and the exception logged. Set callbacks before a
        procedure starts: slope functions and loops read them at construction.
        """
        return self._callbacks

    @callbacks.setter
    def callbacks(self, callbacks: Callbacks) -> None:
        self._callbacks = Callbacks(
            guarded_callback("frames", callbacks.frame),
            guarded_callback("science frames", callbacks.science),
            guarded_callback("slopes", callbacks.slopes),
            guarded_callback("commands", callbacks.command),
            guarded_callback("residuals", callbacks.residual),
            guarded_callback("geometries", callbacks.geometry),
        )
        self.wfs.callback, self.dm.callback = self._callbacks.frame, self._callbacks.command
        if self.science is not None:
            self.science.callback = self._callbacks.science

    @property
    def devices(self) -> tuple[Device, ...]:
        """The devices present, in the order of opening."""
        order = (self.dm, self.wfs, self.modulator, self.science, self.screen)
        return tuple(device for device in order if device is not None)

    @property
    def is_open(self) -> bool:
        """True when every device is open."""
        return all(device.is_open for device in self.devices)

    @property
    def simulated(self) -> bool:
        """True when any device is a twin, by its configured mode or, once open, by its own information."""
        names = ("dm", "wfs", "science", "screen", "modulator")
        present = [(name, getattr(self, name)) for name in names if getattr(self, name) is not None]
        sections = [getattr(self.config.devices, name) for name, _ in present]
        modes = {resolve_mode(section, self.config) for section in sections if section is not None}
        return "sim" in modes or any(device.info.simulated for _, device in present if device.is_open)

    def open(self) -> Self:
        """Open all devices that are not open yet.

        Raises
        ------
        DeviceError
            A device cannot be reached; all devices are closed again.
        """
        if self._threads is None:
            self._threads = limit_to_one_thread()
        try:
            for device in self.devices:
                device.open()
        except BaseException as error:
            self._close_all(error)
            raise
        return self

    def close(self) -> None:
        """Close all devices, the mirror last, also when some of them fail.

        Raises
        ------
        Exception
            The first failure, after all devices were closed; later ones are added as notes.
        """
        first = self._close_all(None)
        if first is not None:
            raise first

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self._close_all(error)

    def model(self, grid: SensorGeometry | None = None) -> SyntheticModel:
        """Build the synthetic model that ``calibration.model`` names.

        Parameters
        ----------
        grid
            Geometry of the sensor as found on the camera; ``None`` for the nominal one.

        Raises
        ------
        ConfigError
            The model is unknown or not installed.
        """
        return model_factory(self.config.calibration.model)(self.config, grid)

    def _close_all(self, cause: BaseException | None) -> BaseException | None:
        """Close in reverse order; add failures as notes to the cause or to the first failure."""
        if self._threads is not None:
            self._threads.restore_original_limits()
            self._threads = None
        first = cause
        for device in reversed(self.devices):
            try:
                device.close()
            except BaseException as error:
                log.error("%s did not close cleanly: %s", device.name, error)
                if first is None:
                    first = error
                else:
                    first.add_note(f"while closing {device.name}: {error!r}")
        return first


def build_device(name: str, config: SystemConfig, kind: type[D]) -> D:
    """Build one device of a system; opens nothing.

    Parameters
    ----------
    name
        Key of the device in ``[devices]``.
    config
        The whole configuration.
    kind
        Required class of the device.

    Raises
    ------
    ConfigError
        The system has no such device in this mode, or its driver is unknown, not installed or of another
        class.
    """
    device = _build(name, getattr(config.devices, name, None), config, {}, kind)
    if device is None:
        raise ConfigError(
            f"system '{config.system.name}' has no driver for devices.{name} in this mode; "
            f"{explain_missing_driver(kind)}"
        )
    return device


def build_standalone_device(driver: str, kind: type[D], /, **settings: Any) -> D:
    """Build one device by its driver, without a system; opens nothing.

    Parameters
    ----------
    driver
        Name of a driver, such as ``"alpao"``.
    kind
        Required class of the device.
    **settings
        Keywords of the driver's class, such as ``serial``. Of a mirror also ``order`` and ``polarity`` and of
        a camera ``flip``, as in a system file; ``limits`` may be a table of those that differ from
        :data:`CAUTIOUS_LIMITS <escape_hw.safety.limits.CAUTIOUS_LIMITS>`.

    Raises
    ------
    ConfigError
        The driver is unknown, not installed, of another class, works as a part of a system only, or does not
        take these settings.
    """
    if not isinstance(driver, str):
        raise ConfigError(f"driver is {driver!r}; it must be the name of one, such as 'alpao'")
    driver_class = device_class(driver, kind)
    _require_arguments(driver, driver_class, settings)
    if issubclass(driver_class, DeformableMirror) and settings.get("limits") is not None:
        settings["limits"] = parse_limits(driver, settings["limits"])
    orientation_section = _orientation_section(driver_class)
    given = {key: settings.pop(key) for key in orientation_section.model_fields if key in settings}
    orientation = parse_options(orientation_section, driver, given)
    device = call_factory(f"driver '{driver}'", kind, partial(driver_class, **settings))
    if isinstance(device, Camera) and isinstance(orientation, CameraOrientation):
        device.flip = orientation.flip
    elif isinstance(device, DeformableMirror) and isinstance(orientation, MirrorOrientation):
        device.order, device.polarity = _order_of(driver, device, orientation.order), orientation.polarity
    return device


def _orientation_section(driver_class: type[Device]) -> type[Section]:
    """Section with the keys that the base class of a device applies; without keys for a stage."""
    if issubclass(driver_class, Camera):
        return CameraOrientation
    return MirrorOrientation if issubclass(driver_class, DeformableMirror) else Section


def _require_arguments(driver: str, driver_class: type[Device], settings: Mapping[str, Any]) -> None:
    """Refuse settings without a keyword that the driver needs, and what is no text where one is needed."""
    for name, parameter in inspect.signature(driver_class).parameters.items():
        value = settings.get(name, "")
        if parameter.annotation in (str, "str") and not isinstance(value, str):
            raise ConfigError(f"{driver}.{name}: {value!r}  must be a string")
        is_needed = parameter.default is parameter.empty and parameter.kind not in (
            parameter.VAR_POSITIONAL,
            parameter.VAR_KEYWORD,
        )
        if is_needed and name not in settings:
            option = "--serial NUMBER" if name == "serial" else f"--set {name}=..."
            raise ConfigError(
                f"driver '{driver}' needs {name}, which is missing; give {name}=..., on the command line "
                f"{option}"
            )


def _order_of(driver: str, mirror: DeformableMirror, order: str) -> NDArray[np.intp] | None:
    """Number in the layout of each actuator of the hardware ``(n_act,)``; ``None``: the same."""
    if order == "none":
        return None
    try:
        return hardware_order(order, _positions_in_pitches(mirror, order))
    except ValueError as error:
        raise ConfigError(f"{driver}.order: {order!r}  {error}") from None


def _positions_in_pitches(mirror: DeformableMirror, order: str) -> NDArray[np.float64]:
    """Positions of the actuators ``(n_act, 2)`` before the mirror is opened; ``ValueError`` if not known."""
    if order.startswith("numbers:"):
        # Needs no positions; opening the mirror compares how many there are.
        return np.zeros((order.count(",") + 1, 2))
    try:
        positions = mirror.info.positions_m
    except NotOpen:
        raise ValueError("needs the arrangement of the actuators; give layout") from None
    pairs = nearest_pairs(positions)
    pitch = np.median(np.hypot(*(positions[pairs[:, 0]] - positions[pairs[:, 1]]).T))
    return np.asarray(positions / pitch)


def open_device(driver: str, /, **settings: Any) -> Any:
    """Open one device by its driver, without a system file.

    For example::

        with escape_hw.open_device("alpao", serial="BAX118") as dm:
            dm.send(dm.flat)

    Every command to a mirror passes the guard, with the limits of :data:`CAUTIOUS_LIMITS
    <escape_hw.safety.limits.CAUTIOUS_LIMITS>` unless ``limits`` gives others.

    Parameters
    ----------
    driver
        Name of a driver, such as ``"alpao"``, ``"ximea"``, ``"pi-e727"`` or ``"asm"``.
    **settings
        Keywords of the driver's class: ``serial``, the options on the page of the device, and ``limits``, all
        (``MirrorLimits``) or a table of those that differ. Also ``order`` and ``polarity`` of a mirror, and
        ``flip`` of a camera, as in a system file.

    Returns
    -------
    Any
        The open device, of the driver's class, which depends on the name. ``dm: escape_hw.DeformableMirror =
        escape_hw.open_device(...)`` states it to type checkers.

    Raises
    ------
    ConfigError
        The driver is unknown, is a twin (which is part of a system), or does not take these settings; nothing
        was opened.
    DeviceError
        The device cannot be reached.
    """
    return build_standalone_device(driver, Device, **settings).open()  # type: ignore[type-abstract]


def resolve_mode(section: DeviceConfig, config: SystemConfig) -> str:
    """Mode of a device: its own, or the system's if it has none."""
    return section.mode or config.system.mode


def _read_pixels(
    camera: SensorCameraConfig, key: Literal["dark_file", "flat_file"]
) -> NDArray[np.float32] | None:
    """The dark frame or flat that a key of the configuration names, ``(rows, columns)``."""
    path = getattr(camera, key)
    if not path:
        return None
    # Reading FITS files takes longer than opening a bench without any.
    from escape_hw.io.fits.pixels import load_pixels

    try:
        image = load_pixels(Path(path).expanduser(), "DARK" if key == "dark_file" else "FLAT").result
    except ProductError as error:
        raise ConfigError(f"devices.wfs.{key}: {error}") from error
    _, _, width, height = camera.region
    if image.shape != (height, width):
        raise ConfigError(
            f"devices.wfs.{key}: {path} has {image.shape[1]} x {image.shape[0]} pixels, devices.wfs.region "
            f"{width} x {height}; measure it again"
        )
    return image


def _build(
    name: str, section: DeviceConfig | None, config: SystemConfig, shared: dict[str, object], kind: type[D]
) -> D | None:
    """Build one device; ``None`` if the system has none in this mode."""
    if section is None:
        return None
    twin = resolve_mode(section, config) == "sim"
    driver = section.sim_driver if twin else section.driver
    if not driver:
        return None
    try:
        factory = device_factory(driver, hardware=not twin)
    except ConfigError as error:
        raise ConfigError(f"devices.{name}: {error}") from error
    context = DeviceContext(name, config, shared)
    device = call_factory(f"devices.{name}: driver '{driver}'", kind, factory, section, context)
    if isinstance(device, Camera) and isinstance(section, CameraConfig):
        device.flip = section.flip
    elif isinstance(device, DeformableMirror) and isinstance(section, MirrorConfig):
        device.order, device.polarity = section.hardware_order(), section.polarity
    return device
