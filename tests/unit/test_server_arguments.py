"""Arguments of procedures from clients, and the transfer of errors."""

from __future__ import annotations

import pytest
from small_system import configuration

from escape_hw import errors
from escape_hw.errors import ConfigError, DeviceLost, EscapeError
from escape_hw.remote.requests import error_from_document, error_to_document
from escape_hw.runtime.procedures.calibration import METHODS
from escape_hw.runtime.procedures.declaration import Parameter, check_arguments
from escape_hw.server.engine.procedures import ProcedureRegistry
from escape_hw.server.engine.product_store import ProductStore

PARAMETERS = (
    Parameter(name="frames", kind="int", default=10, low=1, high=100, unit="frame"),
    Parameter(name="poke", kind="float", default=None, low=0),
    Parameter(name="fast", kind="bool", default=False),
    Parameter(name="solver", kind="choice", default="a", choices=("a", "b")),
    Parameter(name="im", kind="matrix"),
)


def test_what_is_not_said_is_as_offered() -> None:
    assert check_arguments(PARAMETERS, {"poke": 1}) == {
        "frames": 10, "poke": 1.0, "fast": False, "solver": "a", "im": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"frames": 0}, "frames is 0; it must be at least 1 and at most 100 frame"),
        ({"frames": 2.5}, "frames is 2.5; it must be a whole number"),
        ({"frames": True}, "frames is True; it must be a number"),
        ({"frames": "many"}, "frames is 'many'; it must be a number"),
        ({"poke": float("nan")}, "poke is nan; it must be a number"),
        ({"poke": -1}, "poke is -1; it must be at least 0"),
        ({"fast": 1}, "fast is 1; it must be true or false"),
        ({"solver": "c"}, "solver is 'c'; it is one of a, b"),
        ({"im": 3}, "im is 3; it must be text"),
        ({"frame": 3}, "'frame' is no argument of this procedure; did you mean 'frames'?"),
        ({"xyz": 3}, "'xyz' is no argument of this procedure; there are frames, poke, fast, solver, im"),
    ],
)
def test_what_is_wrong_is_named(said: dict, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_arguments(PARAMETERS, said)
    assert str(error.value) == message


def test_all_that_is_wrong_is_reported_together() -> None:
    with pytest.raises(ConfigError, match=r"frames is 0.*poke is -1"):
        check_arguments(PARAMETERS, {"frames": 0, "poke": -1})


def test_every_method_is_offered_with_the_defaults_of_the_configuration(tmp_path) -> None:
    config = configuration()
    procedures = ProcedureRegistry(config)
    entries = {entry.name: entry for entry in procedures.entries}
    assert set(METHODS) < set(entries)
    for name, entry in entries.items():
        # What is offered is accepted, kind by kind and default by default.
        arguments = procedures.arguments(name, {})
        assert arguments == {one.name: one.default for one in entry.parameters}
        if "im" not in arguments:
            procedures.task(name, {}, ProductStore([tmp_path])).load(config)
    assert procedures.arguments("docrime", {})["frames"] == config.calibration.frames
    with pytest.raises(ConfigError, match="no procedure is called 'explode'"):
        procedures.arguments("explode", {})
    with pytest.raises(ConfigError, match=r"Matrix \(im\) is missing"):
        procedures.task("loop", {}, ProductStore([tmp_path]))


@pytest.mark.parametrize(
    "kind",
    [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, EscapeError)],
)
def test_every_error_keeps_its_class_and_message_across_the_wire(kind: type[EscapeError]) -> None:
    error = kind("dm", "lost: it is gone") if issubclass(kind, errors.DeviceError) else kind("it is gone")
    again = error_from_document(error_to_document(error))
    assert type(again) is kind
    assert str(again) == str(error)


def test_a_device_is_still_known_and_a_defect_is_called_one() -> None:
    again = error_from_document(error_to_document(DeviceLost("dm", "unplugged")))
    assert isinstance(again, DeviceLost)
    assert again.device == "dm"
    defect = error_from_document(error_to_document(ZeroDivisionError("oops")))
    assert type(defect) is EscapeError
    assert "ZeroDivisionError: oops (this is a defect of ESCAPE" in str(defect)
    assert type(error_from_document({"type": "SystemExit", "message": "x"})) is EscapeError
    assert str(error_from_document({})) == "the server gave no reason"
