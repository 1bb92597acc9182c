"""The contract suite on real devices: ``pytest --hardware FILE --serial NUMBER --maxchange N``."""

from __future__ import annotations

from functools import partial

import pytest
from hardware_option import CHOSEN

from escape_hw.config.registry import DeviceContext, device_factory
from escape_hw.testing import Check, Factory, checks_for


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    chosen = metafunc.config.stash.get(CHOSEN, None)
    if chosen is None:
        reason = "real devices are tested with --hardware FILE --serial NUMBER only"
        metafunc.parametrize(("factory", "check"), [pytest.param(None, None, marks=pytest.mark.skip(reason))])
        return
    configuration, keys = chosen
    most = metafunc.config.getoption("--maxchange")
    cases = []
    for key in keys:
        section = getattr(configuration.devices, key)
        make = device_factory(section.driver, hardware=True)
        factory = partial(make, section, DeviceContext(key, configuration))
        for check in checks_for(factory(), most):
            cases.append(pytest.param(factory, check, id=f"{key}-{check.__name__.removeprefix('check_')}"))
    metafunc.parametrize(("factory", "check"), cases)


@pytest.mark.hardware
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)
