"""A matrix measured with the earlier, guessed rings of the MMT's mirror is refused on the published ones."""

from __future__ import annotations

from dataclasses import replace

import pytest

from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop
from escape_hw.calibration.loop.control import LoopControl, build_integrator
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import IncompatibleProduct
from escape_hw.io.fits.matrix import MatrixProduct, load_matrix, save_matrix
from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix
from escape_hw.runtime.procedures.sprint import SprintProcedure
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System


def configuration(*more: str) -> SystemConfig:
    return load_system("maps-nir", overrides=("basis.n_modes=12", *more))


@pytest.fixture(scope="module")
def rings(tmp_path_factory: pytest.TempPathFactory) -> MatrixProduct:
    """A matrix of 336 actuators on guessed rings, written and read again."""
    with pytest.warns(RenamedWarning, match="rings-336"):
        config = configuration("devices.dm.layout=rings-336")
    with System.from_config(config) as bench:
        measured = bench.calibrate("docrime", frames=100)
        origin = BenchRecord.from_bench(bench).origin()
    return load_matrix(save_matrix(tmp_path_factory.mktemp("rings") / "im.fits", measured, origin))


def test_a_matrix_knows_its_layout(rings: MatrixProduct) -> None:
    assert rings.matrix.layout == "rings-336"
    assert rings.matrix.m2c.shape == (336, 12)


def test_every_way_to_use_it_in_python_refuses_it(rings: MatrixProduct) -> None:
    found, other = rings.result, "'rings-336' of 336 actuators; devices.dm.layout is 'maps-336', with other"
    with System.from_config(configuration()) as bench:
        for use in (
            lambda: bench.close_loop(rings, frames=10),
            lambda: bench.close_loop(found.matrix, found.grid, frames=10),
            lambda: bench.find_best_gain(found.matrix, found.grid),
            lambda: bench.track(found, seconds=1),
            lambda: bench.run(docrime_closed_loop(bench, found, frames=100)),
            lambda: bench.find_registration(found),
            lambda: LoopControl(bench, found),
        ):
            with pytest.raises(IncompatibleProduct, match=other):
                use()


def test_sprint_refuses_its_file(rings: MatrixProduct) -> None:
    with pytest.raises(IncompatibleProduct, match=r"im\.fits: was measured with the layout 'rings-336'"):
        SprintProcedure(im=rings.path).load(configuration())


def test_the_layout_is_judged_before_modes_and_sub_apertures(rings: MatrixProduct) -> None:
    """No other setting would make the matrix fit, so none is advised."""
    with pytest.raises(IncompatibleProduct, match="was measured with the layout 'rings-336'"):
        SprintProcedure(im=rings.path).load(configuration("sensor.n_sub=24"))
    with pytest.raises(IncompatibleProduct, match="was measured with the layout 'rings-336'"):
        load_fitting_matrix(rings.path, configuration("basis.n_modes=11"))


def test_a_matrix_without_a_layout_is_judged_by_its_numbers(rings: MatrixProduct) -> None:
    bench = System.from_config(configuration())
    control = build_integrator(bench, replace(rings.matrix, layout=""), rings.grid)
    assert control.reconstructor.shape == rings.matrix.data.T.shape
