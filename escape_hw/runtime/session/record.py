"""What a run writes down about the bench it ran on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

from escape_hw.api.registration import Registration
from escape_hw.bench import Bench
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, EscapeError
from escape_hw.io import documents
from escape_hw.io.provenance import Provenance, format_utc, get_git_state, get_software_version


@dataclass(frozen=True, slots=True)
class BenchRecord:
    """Identity of an opened bench, kept after it is closed.

    ``applies_twin_section`` is true if mirror and sensor are simulated as ``[twin]`` says, unlike those of a
    foreign simulation. ``full_scale`` is the count at which the sensor's camera saturates. ``injected`` is
    the true registration, for reports only: no estimator reads it.
    ``request`` holds the options of a run that can be resumed, ``stopped_at`` where a run was aborted.
    """

    system: str
    simulated: bool
    seed: int
    config_text: str
    basis: str
    serials: Mapping[str, str]
    layout: tuple[str, ...]
    places_m: tuple[tuple[float, float], ...]
    psf_px: float | None
    full_scale: int
    applies_twin_section: bool
    injected: Registration | None
    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    request: Mapping[str, Any] | None = None
    stopped_at: Mapping[str, str | int] | None = None

    @classmethod
    def from_bench(cls, bench: Bench) -> BenchRecord:
        """Take it from an open bench."""
        config = bench.config
        devices = {"dm": bench.dm, "wfs": bench.wfs, "modulator": bench.modulator, "science": bench.science}
        science = config.devices.science
        is_twin = bench.dm.applies_twin_section and bench.wfs.applies_twin_section
        # A drifting registration has no single true value.
        is_known = is_twin and not config.twin.drift.is_drifting
        return cls(
            system=config.system.name,
            simulated=bool(bench.simulated),
            seed=config.system.seed,
            config_text=config.to_toml(),
            basis=config.basis.kind,
            serials={name: device.info.serial for name, device in devices.items() if device is not None},
            layout=actuator_layout(bench),
            places_m=actuator_positions(bench),
            psf_px=None if science is None else float(science.psf_px),
            full_scale=bench.wfs.info.full_scale,
            applies_twin_section=is_twin,
            injected=config.twin.registration.to_registration() if is_known else None,
        )

    def with_end(self, stop: EscapeError | None) -> BenchRecord:
        """The record at the end of a run, which ``stop`` may have aborted."""
        return replace(self, stopped_at=stop.stopped_at) if isinstance(stop, Aborted) else self

    def origin(self, parents: Mapping[str, str] | None = None) -> Provenance:
        """Provenance of a product made on this bench."""
        return Provenance(self.config_text, self.basis, self.seed, self.serials, parents or {}, self.started)

    def header_fields(self, command: str) -> dict[str, Any]:
        """What the run's document begins with."""
        return {
            **documents.header_fields(command, self.system, self.simulated, self.seed),
            "software": get_software_version(),
            "git": get_git_state(),
            "started_utc": format_utc(self.started),
            **({} if self.request is None else {"request": dict(self.request)}),
            **({} if self.stopped_at is None else {"stopped_at": dict(self.stopped_at)}),
            "injected": None if self.injected is None else self.injected.to_dict(),
            "bench": {
                "layout": list(self.layout),
                "places_m": [list(place) for place in self.places_m],
                "psf_px": self.psf_px,
                "full_scale": self.full_scale,
            },
        }


def config_provenance(config: SystemConfig) -> Provenance:
    """Provenance of a product computed from a configuration alone, with nothing opened."""
    return Provenance(config.to_toml(), config.basis.kind, config.system.seed, {}, {}, datetime.now(UTC))


def actuator_layout(bench: Bench) -> tuple[str, ...]:
    """Map of the actuators as rows of 0 and 1; empty if they are not on a grid."""
    layout = bench.dm.info.layout
    return () if layout is None else tuple("".join("1" if spot else "0" for spot in row) for row in layout)


def actuator_positions(bench: Bench) -> tuple[tuple[float, float], ...]:
    """Positions (x, y) of actuators without a grid in metres; empty if they have one."""
    info = bench.dm.info
    return () if info.layout is not None else tuple((float(x), float(y)) for x, y in info.positions_m)


@contextmanager
def without_turbulence(bench: Bench) -> Iterator[None]:
    """Take the phase screen out of the beam for a while, when the bench has one."""
    if bench.screen is None or not bench.screen.state.inserted:
        yield
        return
    bench.screen.set(inserted=False)
    try:
        yield
    finally:
        bench.screen.set(inserted=True)
