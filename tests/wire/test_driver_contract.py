"""The contract suite on the real drivers, against the stand-ins of the vendors' libraries."""

from __future__ import annotations

from functools import partial

from driver_bench import PARTS, fresh, make, stand_in

from escape_hw.testing import Check, Factory, parametrize_device_checks

DRIVERS: dict[str, Factory] = {driver: partial(make, driver) for driver in PARTS}


@parametrize_device_checks(DRIVERS)
def test_contract(factory: Factory, check: Check) -> None:
    for _, library in PARTS.values():
        fresh(library)
    check(factory)
    violations = {library: stand_in(library).violations for _, library in PARTS.values()}
    assert not any(violations.values()), violations
