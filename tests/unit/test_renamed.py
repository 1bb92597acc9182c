"""Names, configuration keys and values of version 0.1.0 are accepted with a deprecation warning."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
from small_system import GAUSSIAN_TWIN
from typer.testing import CliRunner

import escape_hw
from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.calibration.acquisition.checkpoint import require_same_run
from escape_hw.cli.app import app
from escape_hw.config.bundled import bundled_text
from escape_hw.config.key_tree import all_keys, locate_key
from escape_hw.config.loader import load_system, load_text
from escape_hw.config.renamed import RENAMED_KEYS, RENAMED_VALUES, present_value
from escape_hw.config.system import SystemConfig
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import ConfigError, IncompatibleProduct
from escape_hw.testing.reference_devices import IdealSecondary, RecordingMirror

SYSTEMS = Path(__file__).parents[1] / "data" / "0.1.0" / "systems"

#: Section -> old key, old value, path of the present key, present value.
CASES: list[tuple[str, str, Any, str, Any]] = [
    ("calibration", "solver", "effects", "calibration.solver", "mixed-effects"),
    ("calibration", "solver", "light", "calibration.solver", "registration-only"),
    ("calibration", "solver", "frozen", "calibration.solver", "frozen-derivatives"),
    ("calibration", "actuators", "found", "calibration.actuator_model", "fitted"),
    ("calibration", "actuators", "alike", "calibration.actuator_model", "nominal"),
    ("calibration", "also", ["anamorphosis"], "calibration.extra_parameters", ("anamorphosis",)),
    ("calibration", "pokes", "shaped", "calibration.pokes", "anticorrelated"),
    ("tracking", "worth", 0.02, "tracking.exchange_threshold", 0.02),
    ("tracking", "limit", 0.4, "tracking.exchange_limit", 0.4),
    ("tracking", "largest_shift", 50.0, "tracking.max_shift", 50.0),
    ("server", "abandoned_s", 3.0, "server.unattended_s", 3.0),
    ("server", "silent_s", 4.0, "server.engine_silence_s", 4.0),
    ("server", "saturated_share", 0.4, "server.saturated_fraction", 0.4),
    ("devices.modulator.stage", "correct", "none", "devices.modulator.stage.correction_source", "none"),
    ("devices.modulator.stage", "round_within", 0.1, "devices.modulator.stage.circle_tolerance", 0.1),
]


def value_at(config: SystemConfig, key: str) -> Any:
    value: Any = config
    for name in key.split("."):
        value = getattr(value, name)
    return value


@pytest.mark.parametrize(("section", "key", "value", "present", "expected"), CASES)
def test_an_old_file_loads_with_a_message_that_names_file_line_and_new_name(
    section: str, key: str, value: Any, present: str, expected: Any
) -> None:
    text = bundled_text("razor-pywfs")
    header, line = f"[{section}]\n", f"{key} = {json.dumps(value)}\n"
    assert key not in {row.split(" ")[0] for row in text.splitlines()} or section == "calibration"
    text = text.replace(header, header + line) if header in text else f"{text}\n{header}{line}"
    number = text[: text.index(line)].count("\n") + 1
    with pytest.warns(RenamedWarning) as record:
        config = load_text(text, "old.toml")
    assert value_at(config, present) == expected
    (message, *more) = [str(warning.message) for warning in record]
    assert message.startswith(f"old.toml:{number}  {section}.{key}")
    assert present.rpartition(".")[2] in message or repr(expected) in message
    assert len(more) == (key == "actuators"), "the key and its value are both renamed"
    assert record[0].filename == __file__, "attributed to the caller, so that Python shows it"


@pytest.mark.parametrize(("section", "key", "value", "present", "expected"), CASES)
def test_an_old_override_works_and_goes_into_files_under_its_new_name(
    section: str, key: str, value: Any, present: str, expected: Any
) -> None:
    with pytest.warns(RenamedWarning) as record:
        config = load_system("razor-pywfs", overrides=[f"{section}.{key}={json.dumps(value)}"])
    assert str(record[0].message).startswith(f"--set  {section}.{key}")
    assert value_at(config, present) == expected
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_text(config.to_toml()) == config


def test_an_override_with_the_new_key_wins_over_the_old_key_of_the_file() -> None:
    text = bundled_text("razor-shwfs") + "\n[tracking]\nworth = 0.5\n"
    with pytest.warns(RenamedWarning):
        config = load_text(text, overrides=["tracking.exchange_threshold=0.25"])
    assert config.tracking.exchange_threshold == 0.25


def test_a_wrong_value_of_an_old_key_is_reported_at_its_line() -> None:
    text = bundled_text("razor-shwfs") + "\n[tracking]\nworth = 5.0\n"
    line = text.count("\n")
    with (
        pytest.warns(RenamedWarning),
        pytest.raises(ConfigError, match=rf"x:{line}  tracking\.exchange_threshold: 5\.0  is out of range"),
    ):
        load_text(text, "x")


def test_old_and_new_key_together_are_refused() -> None:
    text = bundled_text("razor-shwfs") + "\n[tracking]\nworth = 0.5\nexchange_threshold = 0.5\n"
    with pytest.raises(ConfigError, match=r"tracking\.worth: 0\.5  unknown key"):
        load_text(text)


@pytest.mark.parametrize("value", ["3", '"light"', "[1]"])
def test_a_malformed_section_stays_an_error(value: str) -> None:
    with pytest.raises(ConfigError, match="must be a table"):
        load_system("razor-shwfs", overrides=[f"calibration={value}"])


def test_a_whole_table_may_be_overridden_with_old_keys() -> None:
    with pytest.warns(RenamedWarning):
        config = load_system("razor-shwfs", overrides=["tracking={worth=0.5, limit=0.6}"])
    assert (config.tracking.exchange_threshold, config.tracking.exchange_limit) == (0.5, 0.6)


def test_every_renaming_leads_to_a_key_and_from_none() -> None:
    for old, new in RENAMED_KEYS.items():
        assert old not in all_keys()
        assert f"{old.rpartition('.')[0]}.{new}" in all_keys()
    for key, values in RENAMED_VALUES.items():
        field = locate_key(key.split(".")).field
        assert field is not None
        choices = set(field.annotation.__args__)  # type: ignore[union-attr]
        assert choices >= set(values.values())
        assert not choices & set(values)


def test_old_values_work_as_arguments_too() -> None:
    with pytest.warns(RenamedWarning, match="'light' is called 'registration-only' since version 0.2.0"):
        assert present_value("calibration.solver", "light") == "registration-only"
    assert present_value("calibration.solver", "batches") == "batches"
    assert present_value("no.such_key", "light") == "light"


@pytest.mark.parametrize("name", ["razor-shwfs", "razor-pywfs"])
def test_the_bundled_systems_of_0_1_0_load_to_the_same_configuration(name: str) -> None:
    """All of it but the mirror, which is now like measured ones."""
    assert load_system(SYSTEMS / f"{name}.toml") == load_system(name, overrides=GAUSSIAN_TWIN)


@pytest.mark.parametrize("name", ["maps-nir", "maps-vis"])
def test_the_telescopes_of_0_1_0_load_with_their_guessed_layout(name: str) -> None:
    with pytest.warns(RenamedWarning, match="'maps-336' has the published positions"):
        assert load_system(SYSTEMS / f"{name}.toml").devices.dm.layout == "rings-336"


def test_a_checkpoint_of_0_1_0_is_of_the_same_run(tmp_path: Path) -> None:
    now = load_system("razor-shwfs").to_toml()
    saved = now
    for new, old in (
        ('solver = "mixed-effects"', 'solver = "effects"'),
        ('actuator_model = "fitted"', 'actuators = "found"'),
        ("extra_parameters = ", "also = "),
        ("exchange_threshold = ", "worth = "),
        ("engine_silence_s = ", "silent_s = "),
    ):
        assert new in saved
        saved = saved.replace(new, old)
    identity = {"system": "x", "simulated": True, "method": "docrime", "settings": {}, "basis": "0"}
    state = tmp_path / "run.state"
    require_same_run(state, {**identity, "configuration": saved}, {**identity, "configuration": now})
    other = saved.replace('solver = "effects"', 'solver = "light"')
    with pytest.raises(IncompatibleProduct, match=r"differs from this run's in calibration\.solver;"):
        require_same_run(state, {**identity, "configuration": other}, {**identity, "configuration": now})
    with pytest.raises(IncompatibleProduct, match="is not valid in this version"):
        require_same_run(
            state, {**identity, "configuration": "schema = 2"}, {**identity, "configuration": now}
        )


def test_the_command_line_reports_it_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "old.toml"
    file.write_text(bundled_text("razor-shwfs") + "\n[tracking]\nworth = 0.5\n")
    outcome = CliRunner().invoke(app, ["config", "check", str(file), "--json"])
    assert outcome.exit_code == 0
    assert json.loads(outcome.stdout)["schema"] == 1
    lines = [line for line in outcome.stderr.splitlines() if "deprecated" in line]
    assert lines == [
        f"deprecated: {file}:{file.read_text().count(chr(10))}  tracking.worth is called "
        "tracking.exchange_threshold since version 0.2.0; version 0.3.0 removes the old name"
    ]


def test_old_attributes_and_methods_warn_and_lead_to_the_new_ones() -> None:
    mirror = RecordingMirror()
    with pytest.warns(RenamedWarning, match=r"DeformableMirror\.tap is called DeformableMirror\.callback"):
        mirror.tap = print
    assert mirror.callback is print
    with mirror, pytest.warns(RenamedWarning, match=r"DeformableMirror\.obeys") as record:
        assert mirror.obeys(mirror.flat)
    assert record[0].filename == __file__
    secondary = IdealSecondary()
    with secondary, pytest.warns(RenamedWarning, match=r"go is called AdaptiveSecondary\.go_to"):
        secondary.go(ShellState.RESTED)


def test_old_public_names_warn_and_lead_to_the_new_ones() -> None:
    with pytest.warns(RenamedWarning, match=r"escape_hw\.Measured is called escape_hw\.Estimate") as record:
        assert escape_hw.Measured is escape_hw.Estimate
    assert record[0].filename == __file__
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        escape_hw.nothing  # noqa: B018
