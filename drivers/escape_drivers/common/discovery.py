"""Searches given hosts for a device."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from escape_hw.api.discovery import DiscoveredDevice
from escape_hw.errors import DeviceError

log = logging.getLogger(__name__)

#: Longest wait for a host, seconds.
HOST_TIMEOUT_S = 1.0


def probe_hosts(
    hosts: Sequence[str], default_port: int, probe: Callable[[str, str, int], DiscoveredDevice]
) -> list[DiscoveredDevice]:
    """What ``probe(where, host, port)`` finds on each host (``name[:port]``); failures are logged."""
    found = []
    for where in hosts:
        host, _, port = where.partition(":")
        try:
            found.append(probe(where, host, int(port) if port else default_port))
        except DeviceError as error:
            log.info("%s", error)
    return found
