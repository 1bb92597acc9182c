"""Names of the simulated devices."""

import pytest

from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext, device_factory


@pytest.mark.parametrize(
    ("name", "mirror"),
    [
        ("razor-shwfs", "simulated mirror of 97 actuators"),
        ("revolt-shwfs", "simulated mirror of 277 actuators"),
        ("maps-nir", "simulated MMT adaptive secondary"),
    ],
)
def test_simulated_devices_are_not_named_after_those_of_another_system(name: str, mirror: str) -> None:
    config = load_system(name)
    shared: dict[str, object] = {}
    models = {}
    for key in ("dm", "wfs", "science"):
        section = getattr(config.devices, key)
        device = device_factory(section.sim_driver)(section, DeviceContext(key, config, shared))
        models[key] = device.info.model  # type: ignore[attr-defined]
    assert models == {
        "dm": mirror,
        "wfs": "simulated wavefront-sensor camera",
        "science": "simulated science camera",
    }
