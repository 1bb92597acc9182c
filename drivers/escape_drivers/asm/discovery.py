"""Finds adaptive secondaries on given hosts, without taking control."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.link import AsmLink
from escape_drivers.asm.options import DEFAULT_PORT
from escape_hw.api.discovery import DiscoveredDevice
from escape_hw.errors import DeviceError

log = logging.getLogger(__name__)

#: Longest wait for a host, seconds.
_TIMEOUT_S = 1.0


def discover(hosts: Sequence[str]) -> list[DiscoveredDevice]:
    """Entry point ``asm`` of ``escape.discover``."""
    found = []
    for where in hosts:
        host, _, port = where.partition(":")
        link = AsmLink(
            where, (host, int(port) if port.isdigit() else DEFAULT_PORT), m.Role.TELEMETRY, AsmCodec,
            connect_s=_TIMEOUT_S, reply_s=_TIMEOUT_S, on_unsolicited=_ignore,
        )  # fmt: skip
        try:
            welcome = link.connect()
            health = link.request(m.GetHealth(), m.HealthReport)
        except DeviceError as error:
            log.info("%s", error)
            continue
        finally:
            link.disconnect("it was only looked at")
        found.append(_make_entry(link.address, welcome, health))
    return found


def _ignore(message: m.Reply) -> None:
    """Ignore unsolicited messages."""


def _make_entry(address: tuple[str, int], welcome: m.Welcome, health: m.HealthReport) -> DiscoveredDevice:
    host, port = address
    toml = (
        f'[devices.dm]\nmode = "hardware"\ndriver = "asm"\nserial = "{welcome.serial}"\n\n'
        f'[devices.dm.options]\nhost = "{host}"\nport = {port}\n\n'
        f"[devices.dm.limits]\ndisabled = {list(welcome.disabled)}"
    )
    model = f"{welcome.last_command_m.size} actuators, {health.state}" + (", emulated" * welcome.simulated)
    users = (health.owner,) if health.owner else ()
    return DiscoveredDevice("adaptive secondary", model, welcome.serial, f"{host}:{port}", "asm", users, toml)
