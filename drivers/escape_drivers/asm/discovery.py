"""Finds adaptive secondaries on given hosts, without taking control."""

from __future__ import annotations

from collections.abc import Sequence

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.link import AsmLink
from escape_drivers.asm.options import DEFAULT_PORT
from escape_drivers.common.discovery import HOST_TIMEOUT_S, probe_hosts
from escape_hw.api.discovery import DiscoveredDevice, device_section_toml


def discover(hosts: Sequence[str]) -> list[DiscoveredDevice]:
    """Entry point ``asm`` of ``escape.discover``."""
    return probe_hosts(hosts, DEFAULT_PORT, _probe)


def _probe(where: str, host: str, port: int) -> DiscoveredDevice:
    link = AsmLink(
        where, (host, port), m.Role.TELEMETRY, AsmCodec,
        connect_s=HOST_TIMEOUT_S, reply_s=HOST_TIMEOUT_S, on_unsolicited=lambda message: None,
    )  # fmt: skip
    try:
        return _make_entry(host, port, link.connect(), link.request(m.GetHealth(), m.HealthReport))
    finally:
        link.disconnect("status query only")


def _make_entry(host: str, port: int, welcome: m.Welcome, health: m.HealthReport) -> DiscoveredDevice:
    toml = device_section_toml("dm", "asm", welcome.serial) + (
        f'\n\n[devices.dm.options]\nhost = "{host}"\nport = {port}\n\n'
        f"[devices.dm.limits]\ndisabled = {list(welcome.disabled)}"
    )
    model = f"{welcome.last_command_m.size} actuators, {health.state}" + (", emulated" * welcome.simulated)
    users = (health.owner,) if health.owner else ()
    return DiscoveredDevice("adaptive secondary", model, welcome.serial, f"{host}:{port}", "asm", users, toml)
