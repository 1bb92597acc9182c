"""Public names of ``escape_hw``, and an open system's methods on the twin."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_system import SMALL

import escape_hw
from escape_hw.errors import Aborted, ConfigError, IncompatibleProduct

#: Enough for the 30 modes of the small bench.
FRAMES = 300


def imported_for_type_checkers() -> dict[str, str]:
    """Public name -> module, as the block that only type checkers read has it."""
    tree = ast.parse(Path(escape_hw.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        name.name: str(line.module)
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for name in line.names
    }


def test_type_checkers_and_the_interpreter_see_the_same_names() -> None:
    seen = imported_for_type_checkers()
    whole = {name for name, home in escape_hw._PUBLIC_MODULES.items() if home == f"escape_hw.{name}"}
    assert whole == {"errors", "testing"}
    assert {name: home for name, home in escape_hw._PUBLIC_MODULES.items() if name not in whole} == {
        name: home for name, home in seen.items() if name not in whole
    }
    assert set(seen) == set(escape_hw.__all__) - {"__version__"}


PUBLIC_FUNCTIONS = sorted(name for name in escape_hw.__all__ if inspect.isfunction(getattr(escape_hw, name)))


@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS)
def test_public_functions_have_an_explicit_typed_signature(name: str) -> None:
    signature = inspect.signature(getattr(escape_hw, name))
    for parameter in signature.parameters.values():
        if (name, parameter.name) == ("open_device", "settings"):
            continue  # keywords of the driver's class
        assert parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD), parameter
        assert parameter.annotation is not parameter.empty, parameter
    assert signature.return_annotation is not signature.empty


def test_every_public_name_is_in_the_reference() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ([\w.]+)$", page, re.MULTILINE))
    assert set(escape_hw.__all__) - listed == {"__version__", "errors", "testing"}
    for package in ("alpao", "aravis", "asm", "pi", "streams", "ximea"):
        for name in importlib.import_module(f"escape_drivers.{package}").__all__:
            described = f".. autoclass:: escape_drivers.{package}.{name}\n" in page
            assert described or f"{package}.{name}" in listed, name


def test_an_opened_device_can_be_used_by_a_typed_script() -> None:
    """Its class depends on the name of the driver; their common base has neither ``send`` nor frames."""
    assert inspect.signature(escape_hw.open_device).return_annotation == "Any"


def test_sprint_documents_what_it_returns() -> None:
    assert inspect.signature(escape_hw.sprint).return_annotation == "RegistrationEstimate"
    documented = inspect.getdoc(escape_hw.sprint).partition("Returns\n-------\n")[2]
    assert documented.startswith("RegistrationEstimate\n")


def test_errors_and_configuration_do_not_load_the_numerics() -> None:
    code = (
        "import escape_hw, sys, json\n"
        "escape_hw.errors.Aborted, escape_hw.open_system, escape_hw.System\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in json.loads(run.stdout)}
    assert not loaded & {"astropy", "matplotlib", "numba", "OOPAO", "rich", "scipy", "typer"}


@pytest.mark.parametrize(
    ("method", "procedure"),
    [
        ("close_loop", "close_loop"),
        ("find_best_gain", "find_best_gain"),
        ("take_model_psf", "measure_model_psf"),
        ("find_sensor", "find_sensor"),
    ],
)
def test_methods_and_procedures_have_the_same_defaults(method: str, procedure: str) -> None:
    ours = inspect.signature(getattr(escape_hw.System, method)).parameters
    theirs = inspect.signature(getattr(escape_hw, procedure)).parameters
    for name, parameter in ours.items():
        # A calibration tells its own grid; a procedure is handed matrix and grid.
        own_grid = name == "grid" and theirs[name].default is inspect.Parameter.empty
        if name not in ("self", "progress") and not own_grid:
            assert parameter.default == theirs[name].default, name


@pytest.fixture(scope="module")
def bench() -> Iterator[escape_hw.System]:
    with escape_hw.open_system("razor-shwfs", seed=5, set=SMALL) as system:
        yield system


@pytest.fixture
def own_bench() -> Iterator[escape_hw.System]:
    """A bench whose noise does not depend on the tests before."""
    with escape_hw.open_system("razor-shwfs", seed=5, set=SMALL) as system:
        yield system


@pytest.fixture(scope="module")
def found(bench: escape_hw.System) -> escape_hw.CalibrationResult:
    return bench.calibrate("escape", frames=FRAMES)


def test_escape_recovers_the_injected_registration(
    bench: escape_hw.System, found: escape_hw.CalibrationResult
) -> None:
    assert found.matrix.method == "escape"
    assert found.registration is not None
    assert found.registration.converged
    injected = bench.config.twin.registration.to_registration().to_array()
    error = np.abs(found.registration.registration.to_array() - injected)
    assert (error < [5.0, 5.0, 0.2, 1.0, 1.0]).all()
    assert found.measured is not None
    again = bench.find_registration(found.measured, found.grid).registration.to_array()
    assert (np.abs(again - injected) < [5.0, 5.0, 0.2, 1.0, 1.0]).all()


@pytest.mark.parametrize("whiten", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_method_is_the_procedure_of_that_name(whiten: bool) -> None:
    measured = []
    calls: list[Callable[[escape_hw.System], escape_hw.CalibrationResult]] = [
        lambda bench: bench.calibrate("docrime", frames=FRAMES, poke=0.01, whiten=whiten),
        lambda bench: bench.run(escape_hw.docrime(bench, frames=FRAMES, poke=0.01, whiten=whiten)),
    ]
    for call in calls:
        with escape_hw.open_system("razor-shwfs", seed=6, set=SMALL) as system:
            measured.append(call(system))
    assert np.array_equal(measured[0].matrix.data, measured[1].matrix.data)
    assert measured[0].matrix.metrics["poke"] == 0.01
    assert measured[0].matrix.method == ("docrime-whitened" if whiten else "docrime")


def test_push_pull_takes_the_turbulence_out_and_puts_it_back(own_bench: escape_hw.System) -> None:
    bench = own_bench
    assert bench.screen is not None
    seen: list[bool] = []
    set_screen = bench.screen._set
    bench.screen._set = lambda want: (seen.append(want.inserted), set_screen(want))[1]  # type: ignore[method-assign]
    try:
        result = bench.calibrate("push-pull", frames=10)
    finally:
        del bench.screen._set
    assert seen == [False, True]
    assert bench.screen.state.inserted
    assert result.matrix.method == "push-pull"
    estimate = bench.find_registration(result.matrix, result.grid)
    assert estimate.converged, estimate.warnings
    injected = bench.config.twin.registration.to_registration()
    error = estimate.registration.to_array() - injected.to_array()
    assert np.abs(error[:2]).max() < 10.0
    # Vibration moves all slopes of a column together; error bars that forget it are 20 times too small.
    assert np.abs(error / estimate.sigma).max() < 5.0


def test_loop_strehl_and_best_gain(bench: escape_hw.System, found: escape_hw.CalibrationResult) -> None:
    model = bench.take_model_psf(frames=3)
    assert bench.screen is not None
    assert bench.screen.state.inserted
    run = bench.close_loop(found.matrix, found.grid, gain=0.3, frames=400, model_psf=model)
    assert run.stable
    assert run.strehl is not None
    # Thirty modes leave the core barely above the halo, and the sensor lost next to nothing.
    assert 0.005 < run.strehl.peak.value < 1.0
    assert run.lost_frames < 5
    assert not bench.dm.shape.any(), "the mirror must end flat"
    gain, runs = bench.find_best_gain(found.matrix, found.grid, gains=(0.05, 0.3), frames=200)
    assert [each.gain for each in runs] == [0.05, 0.3]
    assert gain == 0.3
    with pytest.raises(IncompatibleProduct):
        bench.close_loop(
            found.matrix, bench.run(escape_hw.find_sensor(_narrower(bench), frames=20)).grid, frames=1
        )


def _narrower(bench: escape_hw.System) -> Any:
    """The same bench asking for brighter sub-apertures: another grid."""
    config = bench.config
    sensor = config.sensor.model_copy(update={"min_flux": 0.9})
    other = escape_hw.System(
        config.model_copy(update={"sensor": sensor}), bench.dm, bench.wfs, bench.science, bench.screen
    )
    return other


def test_an_unknown_method_moves_nothing(bench: escape_hw.System) -> None:
    before = bench.dm.sent_count
    methods = "push-pull, push-pull-fast, modulated, docrime, escape"
    with pytest.raises(ConfigError, match=rf"'pushpull' is unknown; it is one of {methods}"):
        bench.calibrate("pushpull")
    assert bench.dm.sent_count == before


def test_progress_goes_to_standard_error(bench: escape_hw.System, capsys: pytest.CaptureFixture[str]) -> None:
    bench.run(escape_hw.find_sensor(bench, frames=5))
    assert capsys.readouterr() == ("", "")
    bench.run(escape_hw.find_sensor(bench, frames=5), progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "find the lenslet grid: 1 of 5 frames" in err


def test_an_abort_flattens_the_mirror_and_keeps_what_was_measured(bench: escape_hw.System) -> None:
    stop = threading.Event()

    def after_a_while(progress: escape_hw.Progress) -> None:
        if progress.done > FRAMES // 2:
            stop.set()

    procedure = escape_hw.docrime(bench, frames=100 * FRAMES)
    with pytest.raises(Aborted) as caught:
        bench.run(procedure, observers=(after_a_while,), abort=stop)
    assert not bench.dm.shape.any()
    partial = caught.value.partial
    assert isinstance(partial, escape_hw.CalibrationResult)
    assert partial.partial
    assert FRAMES // 2 < partial.frames < 100 * FRAMES
