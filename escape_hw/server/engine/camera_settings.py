"""Settings of the cameras: what a change would do, and the change itself."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

from escape_hw.api.camera import Camera, CameraSettings, Region
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import RequestRefused
from escape_hw.remote.requests import CameraRequest
from escape_hw.remote.state import CameraPlan, CameraValues
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.runner import LoopRunner

log = logging.getLogger(__name__)

#: Fields, with the word, the factor and the unit for texts.
_FIELDS = {
    "exposure_s": ("exposure", 1e3, "ms"), "frame_rate_hz": ("frame rate", 1.0, "Hz"),
    "gain_db": ("gain", 1.0, "dB"),
}  # fmt: skip


class CameraControl:
    """Checks and changes the settings of the cameras."""

    def __init__(self, owner: BenchOwner, loop_runner: LoopRunner) -> None:
        self._owner, self._loop_runner = owner, loop_runner

    def plan(self, request: CameraRequest) -> CameraPlan:
        """What the settings would change; nothing is changed.

        SettingRejected: outside the range of the camera. RequestRefused: there is no such camera.
        """
        camera = self._camera(request)
        now = camera.settings
        wanted = {name: getattr(request, name) for name in _FIELDS}
        given = {name: value for name, value in wanted.items() if value is not None}
        region = now.region if request.region is None else Region(*request.region)
        planned = camera.check(replace(now, region=region, **given))
        name = request.camera
        return CameraPlan(
            camera=name, current=_values(now), planned=_values(planned),
            changes=tuple(_changes(now, planned)), warnings=tuple(self._warnings(name, now, planned)),
            refusal=self._refusal(name, now, planned),
        )  # fmt: skip

    def change(self, request: CameraRequest) -> CameraPlan:
        """Change the settings; errors as for :meth:`plan`, and RequestRefused while the camera is needed.

        For the main thread, or for any thread if :attr:`is_science_in_loop`.
        """
        plan = self.plan(request)
        if plan.refusal:
            raise RequestRefused(plan.refusal)
        owner, camera = self._owner, self._camera(request)
        region = Region(*plan.planned.region)
        values = {name: getattr(plan.planned, name) for name in _FIELDS}
        # An invalid combination is refused before the camera is stopped.
        config = self._configuration(request.camera, plan.planned)
        applied = camera.configure(CameraSettings(region, **values))
        owner.config, owner.config_changed = config, True
        owner.bench.config = config
        self._discard(request.camera, plan)
        log.info("%s camera: %s", request.camera, ", ".join(plan.changes) or "unchanged")
        for warning in plan.warnings:
            log.warning("%s camera: %s", request.camera, warning)
        return plan.model_copy(update={"planned": _values(applied)})

    def is_science_in_loop(self, request: CameraRequest) -> bool:
        """Whether the science camera is to be changed while the loop occupies the main thread."""
        return request.camera == "science" and self._owner.state.snapshot.loop_control is not None

    def _camera(self, request: CameraRequest) -> Camera:
        bench = self._owner.bench
        camera = bench.wfs if request.camera == "wfs" else bench.science
        if camera is None:
            raise RequestRefused("this system has no science camera")
        if not camera.is_open:
            raise RequestRefused(f"the camera '{request.camera}' is not open")
        return camera

    def _refusal(self, name: str, now: CameraSettings, planned: CameraSettings) -> str:
        """Why the settings cannot be applied now; empty if they can."""
        state = self._owner.state.snapshot
        if state.loop_control is not None and state.active_run is None and state.fault is None:
            if name == "wfs":
                return "the loop is closed and would get no frames meanwhile; open it first"
            if planned.region != now.region:
                return "the loop is closed and averages images of the present region; open it first"
            return ""
        try:
            self._owner.state.check_idle()
        except RequestRefused as error:
            return str(error)
        return ""

    def _warnings(self, name: str, now: CameraSettings, planned: CameraSettings) -> Iterator[str]:
        bench, new_region = self._owner.bench, planned.region != now.region
        if name == "science":
            if new_region and self._loop_runner.model_psf is not None:
                yield "the model PSF is discarded: measure it again"
            return
        brighter = planned.exposure_s != now.exposure_s or planned.gain_db != now.gain_db
        if (new_region or brighter) and bench.dark is not None:
            yield "the dark frame is discarded: measure it again"
        if new_region and bench.flat is not None:
            yield "the flat is discarded: measure it again"
        if new_region:
            yield "the sub-apertures are discarded: find the sensor, and measure the matrix again"
        elif planned.frame_rate_hz != now.frame_rate_hz:
            yield "the delay of the loop in frames changes: check the gain before closing the loop"

    def _discard(self, name: str, plan: CameraPlan) -> None:
        """Discard what belongs to the settings before."""
        owner, now, new = self._owner, plan.current, plan.planned
        new_region = new.region != now.region
        if name == "science":
            if new_region:
                self._loop_runner.model_psf = None
                owner.publisher.remove_stream("model_psf")
            return
        if new_region or (new.exposure_s, new.gain_db) != (now.exposure_s, now.gain_db):
            owner.bench.dark = None
        if new_region:
            owner.bench.flat = None
            owner.publisher.set_geometry(None)

    def _configuration(self, name: str, values: CameraValues) -> SystemConfig:
        """The configuration with these settings, which runs record and which is applied on opening again."""
        # The exposure of a triggered camera may exceed the frame by a rounding error.
        exposure = min(values.exposure_s, (1 - 1e-9) / values.frame_rate_hz)
        settings = values.model_dump() | {"exposure_s": exposure, "region": list(values.region)}
        changes = [f"devices.{name}.{key}={value}" for key, value in settings.items()]
        return load_text(self._owner.config.to_toml(), overrides=changes)


def _values(settings: CameraSettings) -> CameraValues:
    region = settings.region
    return CameraValues(
        exposure_s=settings.exposure_s, frame_rate_hz=settings.frame_rate_hz, gain_db=settings.gain_db,
        region=(region.x, region.y, region.width, region.height),
    )  # fmt: skip


def _changes(now: CameraSettings, planned: CameraSettings) -> Iterator[str]:
    for name, (word, factor, unit) in _FIELDS.items():
        before, after = factor * getattr(now, name), factor * getattr(planned, name)
        if f"{before:.6g}" != f"{after:.6g}":
            yield f"{word} {before:.6g} → {after:.6g} {unit}"
    if now.region != planned.region:
        a, b = now.region, planned.region
        yield f"region {a.width} x {a.height} at ({a.x}, {a.y}) → {b.width} x {b.height} at ({b.x}, {b.y})"
