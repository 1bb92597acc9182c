"""CURVE keys: who may reach a server from another machine."""

from __future__ import annotations

from escape_hw.remote.address import is_loopback


def client_keys(address: str) -> tuple[bytes, bytes, bytes] | None:
    """The keys to reach an address with; ``None`` on the same machine."""
    if address.startswith("ipc://") or is_loopback(address.removeprefix("tcp://")):
        return None
    raise NotImplementedError
