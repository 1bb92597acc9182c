"""Fixtures of the drivers' tests."""

from __future__ import annotations

from typing import Any

import pytest
from quick_benches import little_noise

from escape_drivers.pi import modulator
from escape_drivers.pi.transports import make_transport

__all__ = ["little_noise", "short_auto_zero"]


@pytest.fixture
def short_auto_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages on an emulator of their own, whose auto-zero takes a twentieth of its time for each axis."""

    def transport(wire: Any, serial: str, options: dict[str, Any], context: Any) -> Any:
        return make_transport(wire, serial, {"auto-zero": "0.05", **options}, context)

    monkeypatch.setattr(modulator, "make_transport", transport)
