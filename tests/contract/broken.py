"""Devices with defects, also those that the definition of a class refuses."""

from __future__ import annotations

import inspect
from typing import Any

from escape_hw.api.device import Device

#: Name of a case, class, check that must fail (without ``check_``), and the members that break it.
Broken = tuple[str, type[Device], str, dict[str, Any]]


def broken_class(base: type[Device], defects: dict[str, Any]) -> type[Device]:
    """A subclass with these members; final methods are replaced after its definition."""
    members = {name: inspect.getattr_static(base, name, None) for name in defects}
    final = {name for name, member in members.items() if getattr(member, "__final__", False)}
    broken = type("Broken", (base,), {name: one for name, one in defects.items() if name not in final})
    for name in final:
        setattr(broken, name, defects[name])
    return broken
