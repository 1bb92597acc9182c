"""ESCAPE: calibrates adaptive-optics systems without a calibration source.

The names below are the public namespace for scripts::

    import escape_hw

    with escape_hw.open_system("razor-shwfs") as bench:
        result = bench.calibrate("escape", progress=True)
        run = bench.close_loop(result)

Modules are imported on first use of a name.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from escape_hw.deprecation import renamed_attributes
from escape_hw.version import __version__

if TYPE_CHECKING:
    from escape_hw import errors, testing
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
    from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
    from escape_hw.api.device import Device
    from escape_hw.api.influence import InfluenceEstimate, InfluenceProfile
    from escape_hw.api.interaction_matrix import InteractionMatrix
    from escape_hw.api.mirror import DeformableMirror, DMInfo, SendReport
    from escape_hw.api.modulator import Modulation, ModulatorInfo, ModulatorStatus, TipTiltModulator
    from escape_hw.api.phase_screen import PhaseScreen, ScreenInfo, ScreenState
    from escape_hw.api.procedure import Procedure, Progress, Reporter, run
    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import CalibrationResult, Estimate, LoopResult, RegistrationEstimate
    from escape_hw.api.sensor import SensorGeometry, SubApertureGrid
    from escape_hw.bench import open_device
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
    from escape_hw.calibration.sprint.influence_estimate import estimate_influence_functions
    from escape_hw.config.bundled import bundled_systems
    from escape_hw.config.loader import load_system
    from escape_hw.config.registry import DeviceContext, register_device
    from escape_hw.io.fits.influence import load_influence, save_influence
    from escape_hw.io.fits.matrix import load_matrix, save_matrix
    from escape_hw.remote.client import Connection, connect
    from escape_hw.runtime.session.system import System, open_system
    from escape_hw.safety.limits import MirrorLimits

#: Module -> its public names. To publish a name, add it here, to ``__all__`` and to the imports
#: for type checkers above.
_NAMES = {
    "escape_hw.api.adaptive_secondary": "AdaptiveSecondary ShellHealth ShellState",
    "escape_hw.api.camera": "Camera CameraInfo CameraSettings Frame Region",
    "escape_hw.api.device": "Device",
    "escape_hw.api.influence": "InfluenceEstimate InfluenceProfile",
    "escape_hw.api.interaction_matrix": "InteractionMatrix",
    "escape_hw.api.mirror": "DMInfo DeformableMirror SendReport",
    "escape_hw.api.modulator": "Modulation ModulatorInfo ModulatorStatus TipTiltModulator",
    "escape_hw.api.phase_screen": "PhaseScreen ScreenInfo ScreenState",
    "escape_hw.api.procedure": "Procedure Progress Reporter run",
    "escape_hw.api.pyramid": "PyramidPupils",
    "escape_hw.api.registration": "Registration",
    "escape_hw.api.results": "CalibrationResult Estimate LoopResult RegistrationEstimate",
    "escape_hw.api.sensor": "SensorGeometry SubApertureGrid",
    "escape_hw.bench": "open_device",
    "escape_hw.calibration.acquisition.checkpoint": "Checkpoint",
    "escape_hw.calibration.acquisition.model_psf": "measure_model_psf",
    "escape_hw.calibration.acquisition.sensor_setup": "find_sensor measure_dark",
    "escape_hw.calibration.acquisition.stopping": "Target",
    "escape_hw.calibration.docrime.closed_loop": "docrime_closed_loop",
    "escape_hw.calibration.docrime.open_loop": "docrime",
    "escape_hw.calibration.escape.method": "escape",
    "escape_hw.calibration.loop.gain_search": "find_best_gain",
    "escape_hw.calibration.loop.performance": "close_loop",
    "escape_hw.calibration.push_pull.procedure": "push_pull",
    "escape_hw.calibration.sprint.fit": "sprint",
    "escape_hw.calibration.sprint.influence_estimate": "estimate_influence_functions",
    "escape_hw.config.bundled": "bundled_systems",
    "escape_hw.config.loader": "load_system",
    "escape_hw.config.registry": "DeviceContext register_device",
    "escape_hw.io.fits.influence": "load_influence save_influence",
    "escape_hw.io.fits.matrix": "load_matrix save_matrix",
    "escape_hw.remote.client": "Connection connect",
    "escape_hw.runtime.session.system": "System open_system",
    "escape_hw.safety.limits": "MirrorLimits",
}
#: Public name -> its module; ``errors`` and ``testing`` are published as whole modules.
_PUBLIC_MODULES = {
    **{name: module for module, names in _NAMES.items() for name in names.split()},
    "errors": "escape_hw.errors",
    "testing": "escape_hw.testing",
}

__all__ = [
    "AdaptiveSecondary", "CalibrationResult", "Camera", "CameraInfo", "CameraSettings", "Checkpoint",
    "Connection", "DMInfo", "DeformableMirror", "Device", "DeviceContext", "Estimate", "Frame",
    "InfluenceEstimate", "InfluenceProfile", "InteractionMatrix", "LoopResult", "MirrorLimits",
    "Modulation", "ModulatorInfo", "ModulatorStatus", "PhaseScreen", "Procedure", "Progress",
    "PyramidPupils", "Region", "Registration", "RegistrationEstimate", "Reporter", "ScreenInfo",
    "ScreenState", "SendReport", "SensorGeometry", "ShellHealth", "ShellState", "SubApertureGrid",
    "System", "Target", "TipTiltModulator", "__version__", "bundled_systems", "close_loop", "connect",
    "docrime", "docrime_closed_loop", "errors", "escape", "estimate_influence_functions",
    "find_best_gain", "find_sensor", "load_influence", "load_matrix", "load_system", "measure_dark",
    "measure_model_psf", "open_device", "open_system", "push_pull", "register_device", "run",
    "save_influence", "save_matrix", "sprint", "testing",
]  # fmt: skip


#: Names of version 0.1.0 -> present names.
_RENAMED = {"Measured": "Estimate", "best_gain": "find_best_gain", "closed_loop": "close_loop"}


def __getattr__(name: str) -> Any:
    if name in _RENAMED:
        return renamed_attributes(__name__, _RENAMED)(name)
    home = _PUBLIC_MODULES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(home)
    value = module if home == f"{__name__}.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
