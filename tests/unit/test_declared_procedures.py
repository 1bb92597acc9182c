"""Procedures are declared once.

Every interface has the declared parameters, and a new one needs a module and a line.
"""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from small_system import configuration

import escape_hw
from escape_hw.cli import app as application
from escape_hw.cli import main
from escape_hw.cli.calibration.procedure_command import option_name
from escape_hw.config.loader import load_system
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import ConfigError
from escape_hw.remote.client import Connection
from escape_hw.runtime.procedures.calibration import CALIBRATIONS, DocrimeProcedure, EscapeProcedure
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec, check_arguments, parameter
from escape_hw.runtime.procedures.gains import GainsProcedure
from escape_hw.runtime.procedures.loop import LoopProcedure
from escape_hw.runtime.procedures.model_psf import ModelPsfProcedure
from escape_hw.runtime.procedures.registry import PROCEDURES, find_procedure
from escape_hw.runtime.procedures.sensor import SensorProcedure
from escape_hw.runtime.procedures.track import TrackProcedure
from escape_hw.server.engine.procedures import ProcedurePlanner, ProcedureRegistry, offered_parameters
from escape_hw.server.engine.product_store import ProductStore

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "add-a-procedure.md"
#: Parameters of Python methods that no interface but Python has.
PYTHON_ONLY = {
    "self", "progress", "matrix", "grid", "calibration", "model_psf", "until", "checkpoint", "method",
}  # fmt: skip


def command_options(name: str) -> dict[str, Any]:
    """The options of a command, hidden ones included."""
    group: Any = typer.main.get_command(application.app)
    return {option: one for one in group.commands[name].params for option in (*one.opts, *one.secondary_opts)}


@pytest.mark.parametrize("procedure", PROCEDURES, ids=lambda one: one.name)
def test_the_command_has_an_option_for_every_parameter(procedure: type[ProcedureSpec[Any]]) -> None:
    options = command_options("calibrate" if procedure.name in CALIBRATIONS else procedure.name)
    for one in procedure.parameters():
        option = options[option_name(one.name)]
        assert one.help.removesuffix(".") in option.help or procedure.name in CALIBRATIONS
        assert (option_name(f"no-{one.name}") in options) == (one.kind == "bool")
        if one.kind in ("int", "float"):
            limits = getattr(option, "type", option)
            assert (limits.min, limits.max) == (one.low, one.high)
        for old in (*one.deprecated, *one.deprecated_inverse):
            assert options[option_name(old)].hidden


def test_the_server_offers_the_same_parameters_with_the_defaults_of_the_configuration() -> None:
    config = configuration()
    entries = {entry.name: entry for entry in ProcedureRegistry(config).entries}
    for procedure in PROCEDURES:
        declared = offered_parameters(procedure)
        offered = entries[procedure.name].parameters
        assert [one.name for one in offered] == [one.name for one in declared]
        for one, sent in zip(declared, offered, strict=True):
            assert (sent.unit, sent.help, sent.low, sent.high) == (one.unit, one.help, one.low, one.high)
            if one.config_key:
                assert sent.default is not None
    gain = next(one for one in entries["loop"].parameters if one.name == "gain")
    assert gain.default == config.loop.gain


@pytest.mark.parametrize(
    ("method", "procedure"),
    [
        (escape_hw.System.calibrate, EscapeProcedure),
        (escape_hw.System.close_loop, LoopProcedure),
        (escape_hw.System.find_optical_gains, GainsProcedure),
        (escape_hw.System.find_sensor, SensorProcedure),
        (escape_hw.System.take_model_psf, ModelPsfProcedure),
        (escape_hw.System.track, TrackProcedure),
    ],
)
def test_python_methods_have_the_declared_names_defaults_and_help(
    method: Callable[..., Any], procedure: type[ProcedureSpec[Any]]
) -> None:
    declared = {one.name: one for one in procedure.parameters()}
    doc = " ".join((method.__doc__ or "").split())
    for name, one in inspect.signature(method).parameters.items():
        assert one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
        if name not in PYTHON_ONLY:
            assert one.default == declared[name].default, name
            assert declared[name].help.removesuffix(".") in doc


def test_the_client_has_the_parameters_of_all_calibrations() -> None:
    names = set(inspect.signature(Connection.calibrate).parameters) - PYTHON_ONLY - {"arguments"}
    assert names == {one.name for each in CALIBRATIONS.values() for one in offered_parameters(each)}


def test_the_defaults_of_the_numerical_functions_are_the_declared_ones() -> None:
    from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
    from escape_hw.calibration.tracking.tracker import track

    functions = {
        GainsProcedure: bootstrap_gains,
        LoopProcedure: escape_hw.close_loop,
        ModelPsfProcedure: escape_hw.measure_model_psf,
        SensorProcedure: escape_hw.find_sensor,
        TrackProcedure: track,
    }
    for procedure, function in functions.items():
        declared = {one.name: one.default for one in procedure.parameters()}
        for name, one in inspect.signature(function).parameters.items():
            if name in declared:
                assert one.default == declared[name], name


@pytest.mark.parametrize("procedure", PROCEDURES, ids=lambda one: one.name)
def test_declarations_are_complete_and_their_configuration_keys_exist(
    procedure: type[ProcedureSpec[Any]],
) -> None:
    assert procedure.title
    assert procedure.help.endswith(".")
    assert inspect.getdoc(procedure)
    config = load_system("razor-shwfs")
    names = [one.name for one in procedure.parameters()]
    old = [name for one in procedure.parameters() for name in (*one.deprecated, *one.deprecated_inverse)]
    assert len({*names, *old}) == len(names) + len(old)
    for one in procedure.parameters():
        assert one.help.endswith("."), one.name
        if one.config_key:
            section, key = one.config_key.split(".")
            assert hasattr(getattr(config, section), key)
            assert one.default is None
        assert one.config_key or not one.sets_config


def test_names_of_earlier_versions_are_accepted_with_a_warning() -> None:
    with pytest.warns(RenamedWarning, match="plain is called whiten .*with the opposite meaning"):
        assert DocrimeProcedure.from_arguments({"plain": True}).whiten is False
    with pytest.warns(RenamedWarning, match="--memory is called --forgetting-time-s"):
        request = TrackProcedure.from_arguments({"im": "im.fits", "memory": 5.0}, option_name)
    assert request.overrides == ("tracking.forgetting_time_s=5.0",)
    with pytest.warns(RenamedWarning, match="budget is called allowed_strehl_loss"):
        arguments = ProcedureRegistry(configuration()).arguments("gains", {"budget": 0.02})
    assert arguments["allowed_strehl_loss"] == 0.02


def test_options_of_earlier_versions_work_and_name_the_present_ones(
    escape: Any, bench: Any, im: Path, tmp_path: Path
) -> None:
    words = ("loop", "razor-shwfs", "--im", im, "--no-strehl", "--drop", 3, "--out", tmp_path / "loop")
    code, _, err = escape(*words)
    assert code == 0, err
    assert bench.benches[-1].config.loop.dropped_modes == 3
    assert "deprecated: --drop is called --dropped-modes" in err
    words = ("calibrate", "razor-shwfs", "--method", "docrime", "--plain", "--out", tmp_path / "run")
    code, _, err = escape(*words)
    assert code == 0, err
    assert bench.calls[-1] == ("docrime", {"whiten": False})
    assert "deprecated: --plain is called --whiten (with the opposite meaning)" in err
    code, _, err = escape("calibrate", "razor-shwfs", "--method", "modulated", "--accuracy", 1)
    assert code == 2
    assert "--accuracy: it needs --method escape, not modulated" in err


def test_python_methods_accept_names_of_earlier_versions() -> None:
    class Opened(escape_hw.System):
        def __init__(self) -> None:
            self.procedures: list[Any] = []

        def run(self, procedure: Any, **options: Any) -> Any:
            procedure.close()
            return procedure

    with pytest.warns(RenamedWarning, match="keep is called checkpoint"):
        assert Opened().calibrate("docrime", keep=None) is not None  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="closing"):
        Opened().track(None, closing=1)  # type: ignore[call-arg,arg-type]


def test_values_that_exclude_each_other_are_refused() -> None:
    with pytest.raises(ConfigError, match="gain and best_gain exclude each other"):
        LoopProcedure(im=Path("im.fits"), gain=0.3, best_gain=True)
    with pytest.raises(ConfigError, match="open loop only"):
        EscapeProcedure(whiten=False, closed_loop=Path("im.fits"))
    with pytest.raises(ConfigError, match="frames is 0; it must be at least 1"):
        SensorProcedure(frames=0)


def test_several_choices_become_a_list_of_the_configuration() -> None:
    request = EscapeProcedure(extra_parameters="anamorphosis, pupil_shift", solver="batches")
    (solver, extra) = request.overrides
    assert solver == "calibration.solver=batches"
    config = load_system("razor-pywfs", overrides=[extra])
    assert "['anamorphosis', 'pupil_shift']" in extra
    assert config.system.name == "razor-pywfs"
    with pytest.raises(ConfigError, match="extra_parameters is 'tilt'; it is one of anamorphosis"):
        EscapeProcedure(extra_parameters="tilt")


def test_a_parameter_of_an_unknown_type_needs_a_kind() -> None:
    class Odd(ProcedureSpec[None]):
        name = "odd"
        value: Path | None = parameter(default=None)

    with pytest.raises(TypeError, match="needs an explicit kind"):
        Odd.parameters()


def test_unknown_and_missing_arguments_are_named() -> None:
    parameters = (Parameter("im", "matrix", required=True, help="A matrix."), Parameter("frames", "int", 3))
    with pytest.raises(ConfigError, match=r"'frmes' is no argument.*did you mean 'frames'.*im is missing"):
        check_arguments(parameters, {"frmes": 3})
    with pytest.raises(ConfigError, match="no procedure is called 'explode'"):
        find_procedure("explode")


def test_declarations_load_no_numerical_library() -> None:
    code = (
        "import sys, escape_hw.runtime.procedures.registry\n"
        "heavy = {'numpy', 'scipy', 'astropy', 'matplotlib', 'pydantic', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture
def brightness(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[ProcedureSpec[Any]]]:
    """The procedure of the page, registered as the page says."""
    source = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S)[0]
    module = types.ModuleType("brightness")
    monkeypatch.setitem(sys.modules, "brightness", module)
    exec(compile(source, str(PAGE), "exec"), module.__dict__)
    procedure: type[ProcedureSpec[Any]] = module.BrightnessProcedure
    PROCEDURES.append(procedure)
    monkeypatch.setattr(application, "app", application.build_app())
    yield procedure
    PROCEDURES.remove(procedure)


def test_a_new_procedure_runs_from_command_line_server_and_python(
    brightness: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ("basis.n_modes=30", "calibration.sprint_modes=30", "loop.dropped_modes=2")
    sets = [word for one in few for word in ("--set", one)]
    words = ["brightness", "razor-shwfs", "--frames", "20", *sets, "--out", str(tmp_path / "run"), "--json"]
    with pytest.raises(SystemExit) as ended:
        main(words)
    document = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert document["mean"] > 0
    assert document == {**document, **json.loads((tmp_path / "run" / "result.json").read_text())}
    with pytest.raises(SystemExit) as ended:
        main(["brightness", "razor-shwfs", "--frames", "1"])
    assert ended.value.code == 2
    assert "--frames" in capsys.readouterr().err

    with escape_hw.open_system("razor-shwfs", set=few) as bench:
        assert bench.run(brightness(frames=20)).mean == pytest.approx(document["mean"], rel=0.2)
        registry = ProcedureRegistry(bench.config)
        entry = next(one for one in registry.entries if one.name == "brightness")
        assert [(one.name, one.kind, one.default) for one in entry.parameters] == [("frames", "int", 50)]
        arguments = registry.arguments("brightness", {"frames": 20})
        assert ProcedurePlanner(bench).plan("brightness", arguments).frames == 20
        task = registry.task("brightness", {"frames": 20}, ProductStore([tmp_path]))
        assert bench.run(task.procedure(bench, None)).mean > 0
    with pytest.raises(ConfigError, match="frames is 1; it must be at least 2"):
        brightness(frames=1)
