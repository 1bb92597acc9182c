"""ESCAPE: calibrates adaptive-optics systems without a calibration source.

The names below are the public namespace for scripts::

    import escape_hw

    with escape_hw.open_system("razor-shwfs") as bench:
        found = bench.calibrate("escape", progress=True)
        run = bench.close_loop(found)

They are loaded when first used, so that importing the package stays cheap.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

from escape_hw.version import __version__

if TYPE_CHECKING:
    from escape_hw import errors, testing
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
    from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
    from escape_hw.api.interaction_matrix import InteractionMatrix
    from escape_hw.api.mirror import DeformableMirror, DMInfo, SendReport
    from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
    from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
    from escape_hw.api.procedure import Procedure, Progress, Reporter, run
    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import CalibrationResult, Estimate, LoopResult, RegistrationEstimate
    from escape_hw.api.sensor import SensorGeometry, SubApertureGrid
    from escape_hw.calibration.acquisition.checkpoint import Checkpoint
    from escape_hw.calibration.acquisition.model_psf import measure_model_psf
    from escape_hw.calibration.acquisition.sensor_setup import find_sensor, measure_dark
    from escape_hw.calibration.acquisition.stopping import Target
    from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop
    from escape_hw.calibration.docrime.open_loop import docrime
    from escape_hw.calibration.escape.method import escape
    from escape_hw.calibration.loop.gain_search import find_best_gain
    from escape_hw.calibration.loop.performance import close_loop
    from escape_hw.calibration.push_pull.procedure import push_pull
    from escape_hw.calibration.sprint.fit import sprint
    from escape_hw.config.bundled import bundled_systems
    from escape_hw.config.loader import load_system
    from escape_hw.config.registry import register_device
    from escape_hw.io.fits.matrix import load_matrix, save_matrix
    from escape_hw.remote.client import Connection, connect
    from escape_hw.runtime.session.system import System, open_system
    from escape_hw.safety.limits import MirrorLimits

#: Public name -> module that defines it (a module of that very name is published as a whole). Add a
#: line here, to ``__all__`` and to the block for type checkers above to publish a name.
_PUBLIC_MODULES = {
    "AdaptiveSecondary": "escape_hw.api.adaptive_secondary",
    "Camera": "escape_hw.api.camera",
    "CameraInfo": "escape_hw.api.camera",
    "CameraSettings": "escape_hw.api.camera",
    "CalibrationResult": "escape_hw.api.results",
    "Checkpoint": "escape_hw.calibration.acquisition.checkpoint",
    "Connection": "escape_hw.remote.client",
    "DMInfo": "escape_hw.api.mirror",
    "DeformableMirror": "escape_hw.api.mirror",
    "Frame": "escape_hw.api.camera",
    "Estimate": "escape_hw.api.results",
    "InteractionMatrix": "escape_hw.api.interaction_matrix",
    "LoopResult": "escape_hw.api.results",
    "MirrorLimits": "escape_hw.safety.limits",
    "Modulation": "escape_hw.api.modulator",
    "ModulatorInfo": "escape_hw.api.modulator",
    "ModulatorStatus": "escape_hw.api.modulator",
    "PhaseScreen": "escape_hw.api.phase_screen",
    "Procedure": "escape_hw.api.procedure",
    "Progress": "escape_hw.api.procedure",
    "PyramidPupils": "escape_hw.api.pyramid",
    "Region": "escape_hw.api.camera",
    "Registration": "escape_hw.api.registration",
    "RegistrationEstimate": "escape_hw.api.results",
    "Reporter": "escape_hw.api.procedure",
    "ScreenInfo": "escape_hw.api.phase_screen",
    "ScreenState": "escape_hw.api.phase_screen",
    "SendReport": "escape_hw.api.mirror",
    "SensorGeometry": "escape_hw.api.sensor",
    "ShellHealth": "escape_hw.api.adaptive_secondary",
    "ShellState": "escape_hw.api.adaptive_secondary",
    "SubApertureGrid": "escape_hw.api.sensor",
    "System": "escape_hw.runtime.session.system",
    "Target": "escape_hw.calibration.acquisition.stopping",
    "TipTiltModulator": "escape_hw.api.modulator",
    "bundled_systems": "escape_hw.config.bundled",
    "close_loop": "escape_hw.calibration.loop.performance",
    "connect": "escape_hw.remote.client",
    "docrime": "escape_hw.calibration.docrime.open_loop",
    "docrime_closed_loop": "escape_hw.calibration.docrime.closed_loop",
    "errors": "escape_hw.errors",
    "escape": "escape_hw.calibration.escape.method",
    "find_best_gain": "escape_hw.calibration.loop.gain_search",
    "find_sensor": "escape_hw.calibration.acquisition.sensor_setup",
    "load_matrix": "escape_hw.io.fits.matrix",
    "load_system": "escape_hw.config.loader",
    "measure_dark": "escape_hw.calibration.acquisition.sensor_setup",
    "measure_model_psf": "escape_hw.calibration.acquisition.model_psf",
    "open_system": "escape_hw.runtime.session.system",
    "push_pull": "escape_hw.calibration.push_pull.procedure",
    "register_device": "escape_hw.config.registry",
    "run": "escape_hw.api.procedure",
    "save_matrix": "escape_hw.io.fits.matrix",
    "sprint": "escape_hw.calibration.sprint.fit",
    "testing": "escape_hw.testing",
}

__all__ = [
    "AdaptiveSecondary",
    "CalibrationResult",
    "Camera",
    "CameraInfo",
    "CameraSettings",
    "Checkpoint",
    "Connection",
    "DMInfo",
    "DeformableMirror",
    "Estimate",
    "Frame",
    "InteractionMatrix",
    "LoopResult",
    "MirrorLimits",
    "Modulation",
    "ModulatorInfo",
    "ModulatorStatus",
    "PhaseScreen",
    "Procedure",
    "Progress",
    "PyramidPupils",
    "Region",
    "Registration",
    "RegistrationEstimate",
    "Reporter",
    "ScreenInfo",
    "ScreenState",
    "SendReport",
    "SensorGeometry",
    "ShellHealth",
    "ShellState",
    "SubApertureGrid",
    "System",
    "Target",
    "TipTiltModulator",
    "__version__",
    "bundled_systems",
    "close_loop",
    "connect",
    "docrime",
    "docrime_closed_loop",
    "errors",
    "escape",
    "find_best_gain",
    "find_sensor",
    "load_matrix",
    "load_system",
    "measure_dark",
    "measure_model_psf",
    "open_system",
    "push_pull",
    "register_device",
    "run",
    "save_matrix",
    "sprint",
    "testing",
]


#: Names of version 0.1.0 -> present names; they will go with version 0.3.0.
_RENAMED = {"Measured": "Estimate", "best_gain": "find_best_gain", "closed_loop": "close_loop"}


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        warnings.warn(
            f"escape_hw.{name} is called escape_hw.{_RENAMED[name]} since version 0.2.0",
            DeprecationWarning,
            stacklevel=2,
        )
        name = _RENAMED[name]
    home = _PUBLIC_MODULES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(home)
    value = module if home == f"{__name__}.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
