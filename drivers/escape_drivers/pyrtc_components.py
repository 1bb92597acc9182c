"""Our cameras and mirrors as components of pyRTC 2.x.

This module extends classes of pyRTC (package ``pyrtcao``, GPL-3.0-or-later) and is licensed under
GPL-3.0-or-later as well. Nothing else in ESCAPE imports it; pyRTC finds it by its name::

    wfs:
      class_name: escape_drivers.pyrtc_components.EscapeCamera
      system: my-bench.toml
      width: 400
      height: 400
      functions: [expose]
    wfc:
      class_name: escape_drivers.pyrtc_components.EscapeMirror
      system: my-bench.toml
      num_actuators: 97
      num_modes: 94
      m2c_file: m2c.npy
      functions: [send_to_hardware]

``set`` (a list of ``KEY=VALUE``) and ``mode`` (``sim`` or ``hardware``) mean what they mean to ``escape``.
Twins share their bench within one process, so they need pyRTC's soft mode.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyrtc.wavefront_corrector import WavefrontCorrector
from pyrtc.wavefront_sensor import WavefrontSensor

from escape_hw.api.camera import Camera
from escape_hw.api.mirror import DeformableMirror
from escape_hw.bench import Bench
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError, FrameTimeout

_KEYS = ("system", "set", "mode", "timeout_s")
#: Maximum wait for a frame before pyRTC can check for a stop request, in seconds.
_WAIT_S = 0.5

_benches: dict[tuple[str, ...], Bench] = {}
_lock = threading.Lock()


def shared_bench(conf: dict[str, Any]) -> Bench:
    """The bench of a component's section; sections that agree share one. Its devices are not open."""
    system = str(conf.get("system") or "")
    if not system:
        raise ConfigError("system: ''  names no system of ESCAPE's; enter a name or a TOML file")
    overrides = tuple(str(one) for one in conf.get("set") or ())
    mode = conf.get("mode")
    with _lock:
        key = (system, str(mode), *overrides)
        if key not in _benches:
            _benches[key] = Bench.from_config(load_system(system, overrides=overrides, mode=mode))
        return _benches[key]


class EscapeCamera(WavefrontSensor):  # type: ignore[misc]  # pyRTC is not typed
    """The wavefront sensor's camera of a system as pyRTC's ``wfs``.

    Parameters
    ----------
    conf
        The section ``wfs``; ``width`` and ``height`` are those of the region that the system reads, else
        ``ConfigError`` is raised.
    """

    EXTRA_CONFIG_KEYS = _KEYS

    def __init__(self, conf: dict[str, Any]) -> None:
        bench = shared_bench(conf)
        region = bench.config.devices.wfs.settings().region
        if (conf.get("width"), conf.get("height")) != (region.width, region.height):
            raise ConfigError(
                f"wfs.width and wfs.height are {conf.get('width')} and {conf.get('height')}; system "
                f"'{bench.config.system.name}' reads {region.width} x {region.height} pixels"
            )
        self.camera: Camera = bench.wfs.open()
        self._wait_s = float(conf.get("timeout_s", _WAIT_S))
        try:
            super().__init__(conf)
        except BaseException:
            self.camera.close()
            raise

    def expose(self) -> None:
        """Publish the next frame; none, when none comes in time, which pyRTC's watchdog then sees."""
        try:
            self.data = self.camera.next_frame(self._wait_s).data
        except FrameTimeout as late:
            self.logger.warning("%s", late)
            return
        super().expose()

    def close(self, *arguments: Any, **more: Any) -> None:
        """End pyRTC's threads, then close the camera."""
        try:
            super().close(*arguments, **more)
        finally:
            self.camera.close()


class EscapeMirror(WavefrontCorrector):  # type: ignore[misc]  # pyRTC is not typed
    """The deformable mirror of a system as pyRTC's ``wfc``.

    Every command passes the guard: one that is not finite is refused and the mirror keeps its shape, one
    beyond a limit is made legal. Closing leaves the mirror flat.

    Parameters
    ----------
    conf
        The section ``wfc``; ``num_actuators`` is that of the system, else ``ConfigError`` is raised.
    """

    EXTRA_CONFIG_KEYS = _KEYS

    def __init__(self, conf: dict[str, Any]) -> None:
        bench = shared_bench(conf)
        n_act = bench.config.devices.dm.n_act
        if conf.get("num_actuators") != n_act:
            raise ConfigError(
                f"wfc.num_actuators is {conf.get('num_actuators')}; the mirror of system "
                f"'{bench.config.system.name}' has {n_act}"
            )
        self.mirror: DeformableMirror = bench.dm.open()
        try:
            super().__init__(conf)
            if self.mirror.info.layout is not None:
                self.set_layout(self.mirror.info.layout)
            self.mirror.flatten()
        except BaseException:
            self.mirror.close()
            raise

    def basis_actuator_positions(self) -> NDArray[np.float64]:
        """Positions of the actuators ``(n_act, 2)`` in metres, for modal bases computed by pyRTC."""
        return self.mirror.info.positions_m

    def send_to_hardware(self) -> None:
        """Send the newest command of the loop."""
        super().send_to_hardware()
        self.mirror.send(self.current_shape)

    def close(self, *arguments: Any, **more: Any) -> None:
        """End pyRTC's threads, then flatten and close the mirror."""
        try:
            super().close(*arguments, **more)
        finally:
            self.mirror.close()
