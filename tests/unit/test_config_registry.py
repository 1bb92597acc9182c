"""Drivers and models by name."""

import importlib.metadata
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from escape_hw.bench import Bench
from escape_hw.config import registry
from escape_hw.config.loader import load_system
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import ConfigError

FACTORY_SOURCE = """
def make(section, context):
    return context.name


def of_0_1_0(name, config, shared):
    return f"{name} of {config.system.name}"

LIMIT = 3


def too_few(section):
    return section


def fails(section, context):
    return section.no_such_key


def forgets(section, context):
    pass


def model(config):
    return config


def no_model(config, grid):
    return config


from escape_hw import DeformableMirror


class Halfway(DeformableMirror):
    pass
"""


@pytest.fixture(autouse=True)
def read_again() -> Iterator[None]:
    """Entry points are read in each test, and not kept from it."""
    registry._installed.cache_clear()
    yield
    registry._installed.cache_clear()


@pytest.fixture
def plug(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package on disk, as somebody else would ship it, and its entry points."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "plug_mirror.py").write_text(FACTORY_SOURCE)
    (tmp_path / "plug_needy.py").write_text("import a_vendor_library_nobody_has\n")
    folder = tmp_path / "plug-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: plug\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[escape.devices]\n"
        "plug-mirror = plug_mirror:make\n"
        "plug-number = plug_mirror:LIMIT\n"
        "plug-typo = plug_mirror:mkae\n"
        "plug-gone = plug_gone.devices:make\n"
        "plug-few = plug_mirror:too_few\n"
        "plug-old = plug_mirror:of_0_1_0\n"
        "plug-class = plug_mirror:Halfway\n"
        "plug-fails = plug_mirror:fails\n"
        "plug-forgets = plug_mirror:forgets\n"
        "plug-needy = plug_needy:make\n"
        "plug-extra = plug_needy:make [vendor]\n"
        "[escape.models]\n"
        "plug-model = plug_mirror:model\n"
        "plug-none = plug_mirror:no_model\n"
    )
    for module in ("plug_mirror", "plug_needy"):
        monkeypatch.delitem(sys.modules, module, raising=False)


@pytest.mark.usefixtures("plug")
def test_a_third_party_driver_is_found_by_its_entry_point() -> None:
    assert "plug-mirror" in registry.available(registry.DEVICES)
    assert "plug-mirror" not in registry.available(registry.MODELS)
    factory = registry.device_factory("plug-mirror")
    assert str(factory(None, registry.DeviceContext("dm"))) == "dm"


@pytest.mark.usefixtures("plug")
def test_a_factory_of_version_0_1_0_works_with_a_warning() -> None:
    with pytest.warns(RenamedWarning, match=r"'plug-old' of plug: .* takes \(name, config, shared\); "):
        factory = registry.device_factory("plug-old")
    context = registry.DeviceContext("dm", load_system("razor-shwfs"))
    assert str(factory(None, context)) == "dm of razor-shwfs"
    with pytest.raises(ConfigError, match="dm: is part of a system and cannot be opened alone"):
        factory(None, registry.DeviceContext("dm"))


@pytest.mark.usefixtures("plug")
def test_a_function_and_a_twin_are_not_opened_alone() -> None:
    for name in ("plug-mirror", "sim-alpao"):
        with pytest.raises(ConfigError, match=f"'{name}' works as a part of a system only; open the system"):
            registry.device_class(name)
    with pytest.raises(ConfigError, match=r"no driver for real hardware 'alpaka' .*did you mean 'alpao'"):
        registry.device_class("alpaka")


@pytest.mark.usefixtures("plug")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plug-miror", r"no device driver 'plug-miror' is installed \(did you mean 'plug-mirror'\?"),
        ("plug-number", r"device driver 'plug-number' of plug is broken: plug_mirror:LIMIT is not callable"),
        (
            "plug-few",
            r"'plug-few' of plug is broken: plug_mirror:too_few takes \(section\) \(too many positional "
            r"arguments\); it is called as factory\(section, context\)",
        ),
        (
            "plug-class",
            r"'plug-class' of plug is broken: .*:Halfway has no class method from_section\(",
        ),
        ("plug-typo", r"device driver 'plug-typo' of plug is broken: plug_mirror:mkae does not exist"),
        ("plug-gone", r"module plug_gone\.devices is not installed .* pip install --force-reinstall plug$"),
        ("plug-needy", r"needs the Python module 'a_vendor_library_nobody_has'.* pip install 'a_vendor_"),
        (
            "plug-extra",
            r"needs the Python module 'a_vendor_library_nobody_has'.* pip install 'plug\[vendor\]'",
        ),
    ],
)
def test_what_cannot_be_loaded_states_what_to_do(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        registry.device_factory(name)


@pytest.mark.usefixtures("plug")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "plug-mirror",
            "creates a str, not a DeformableMirror; plug_mirror:make must return one",
        ),
        ("plug-forgets", "creates a NoneType, not a DeformableMirror; plug_mirror:forgets must return one"),
        (
            "plug-fails",
            r"cannot be created: plug_mirror:fails failed with AttributeError: .*no_such_key.* line",
        ),
    ],
)
def test_what_makes_no_mirror_is_named_with_what_is_expected(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        Bench.from_config(load_system("razor-shwfs", overrides=[f"devices.dm.sim_driver={name}"]))
    assert str(caught.value).startswith("devices.dm: driver")


@pytest.mark.usefixtures("plug")
def test_a_broken_model_is_named_with_what_is_expected() -> None:
    with pytest.raises(ConfigError, match=r"takes \(config\).*called as factory\(config, grid\)"):
        registry.model_factory("plug-model")
    with pytest.raises(
        ConfigError, match="'plug-none' creates a SystemConfig, not a SyntheticModel; plug_mi"
    ):
        registry.model_factory("plug-none")(load_system("razor-shwfs"), None)


@pytest.mark.parametrize("factory", [3, lambda name: name])
def test_what_is_no_factory_is_not_registered(monkeypatch: pytest.MonkeyPatch, factory: object) -> None:
    monkeypatch.setattr(registry, "_REGISTERED", {})
    with pytest.raises(ConfigError, match=r"'bench-mirror' is broken: .* factory\(section, context"):
        registry.register_device("bench-mirror", factory)  # type: ignore[arg-type]


def test_unknown_model() -> None:
    with pytest.raises(ConfigError, match="no synthetic model 'slow' is installed"):
        registry.model_factory("slow")


def entries(*found: EntryPoint) -> object:
    return lambda *, group: EntryPoints(e for e in found if e.group == group)


def test_a_name_offered_by_two_packages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    one = EntryPoint("twin", "package_one.devices:make", registry.DEVICES)
    two = EntryPoint("twin", "package_two:make", registry.DEVICES)
    monkeypatch.setattr(importlib.metadata, "entry_points", entries(one, two))
    with pytest.raises(ConfigError, match=r"'twin' is provided twice: .*package_one.* and .*package_two"):
        registry.device_factory("twin")


def test_the_same_entry_seen_twice_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("twin", "math:hypot", registry.DEVICES)
    monkeypatch.setattr(importlib.metadata, "entry_points", entries(entry, entry))
    assert registry.device_factory("twin").__name__ == "hypot"
    assert registry.available(registry.DEVICES) == ("twin",)


def test_entry_points_are_read_once_and_again_for_an_unknown_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package may be installed while Python runs."""
    twin, later = (EntryPoint(name, "math:hypot", registry.DEVICES) for name in ("twin", "later"))
    monkeypatch.setattr(importlib.metadata, "entry_points", entries(twin))
    assert registry.device_factory("twin").__name__ == "hypot"
    monkeypatch.setattr(importlib.metadata, "entry_points", entries(later))
    assert registry.device_factory("twin").__name__ == "hypot"
    assert registry.device_factory("later").__name__ == "hypot"


def test_nothing_installed_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "entry_points", entries())
    with pytest.raises(ConfigError, match="is escape-hw itself installed in this environment"):
        registry.device_factory("sim-alpao")


def test_a_script_may_register_a_driver_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_REGISTERED", {})
    with pytest.raises(ConfigError, match="no device driver 'bench-mirror' is installed"):
        registry.device_factory("bench-mirror")
    for number in (1, 2):
        factory = lambda section, context, number=number: number  # noqa: E731
        registry.register_device("bench-mirror", factory)
        assert registry.device_factory("bench-mirror") is factory
    assert "bench-mirror" in registry.available(registry.DEVICES)
    assert "bench-mirror" not in registry.available(registry.MODELS)
    with pytest.raises(ConfigError, match="did you mean 'bench-mirror'"):
        registry.device_factory("bench-miror")
    with pytest.raises(ConfigError, match="'sim-alpao' is provided by an installed package"):
        registry.register_device("sim-alpao", factory)


def test_a_twin_is_never_offered_instead_of_a_driver() -> None:
    with pytest.raises(ConfigError) as refused:
        registry.device_factory("alpaka", hardware=True)
    assert "no driver for real hardware 'alpaka' is installed" in str(refused.value)
    assert "sim-" not in str(refused.value)
    assert "--mode" not in str(refused.value), "a driver alone has no mode"


@pytest.mark.usefixtures("plug")
def test_drivers_of_real_hardware_are_named() -> None:
    with pytest.raises(ConfigError, match=r"did you mean 'plug-mirror'\? installed: .*plug-mirror"):
        registry.device_factory("plug-miror", hardware=True)
