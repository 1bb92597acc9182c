"""Asks hosts for adaptive secondaries, without taking control."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from escape_drivers import asm_messages as m
from escape_drivers.asm_codec import AsmCodec
from escape_drivers.asm_link import AsmLink
from escape_drivers.asm_options import PORT
from escape_hw.api.discovery import Found
from escape_hw.errors import DeviceError

log = logging.getLogger(__name__)

#: Longest wait for a host, seconds.
_PATIENCE_S = 1.0


def discover(hosts: Sequence[str]) -> list[Found]:
    """Entry point ``asm`` of ``escape.discover``."""
    found = []
    for where in hosts:
        host, _, port = where.partition(":")
        link = AsmLink(
            where, (host, int(port) if port.isdigit() else PORT), m.Role.TELEMETRY, AsmCodec,
            connect_s=_PATIENCE_S, reply_s=_PATIENCE_S, unasked=_nothing,
        )  # fmt: skip
        try:
            welcome = link.connect()
            health = link.ask(m.GetHealth(), m.Health)
        except DeviceError as error:
            log.info("%s", error)
            continue
        finally:
            link.drop("it was only looked at")
        found.append(_found(link.address, welcome, health))
    return found


def _nothing(news: m.Reply) -> None:
    """What is told unasked does not matter here."""


def _found(address: tuple[str, int], welcome: m.Welcome, health: m.Health) -> Found:
    host, port = address
    toml = (
        f'[devices.dm]\nmode = "hardware"\ndriver = "asm"\nserial = "{welcome.serial}"\n\n'
        f'[devices.dm.options]\nhost = "{host}"\nport = {port}\n\n'
        f"[devices.dm.limits]\ndisabled = {list(welcome.disabled)}"
    )
    model = f"{welcome.present.size} actuators, {health.state}" + (", emulated" * welcome.simulated)
    users = (health.owner,) if health.owner else ()
    return Found("adaptive secondary", model, welcome.serial, f"{host}:{port}", "asm", users, toml)
