"""Independent motion of neighbouring spots in the model, without which shifts and scalings are biased."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.registry import model_factory
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System
from escape_sim.models import shack_hartmann

#: The true mirror is the nominal one, so that the matrix depends on the sensor and the registration alone.
EXACT = [
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4", "twin.mirror.shape=gaussian",
    "twin.mirror.coupling=0.4", "twin.mirror.gain_scatter=0", "twin.mirror.width_scatter=0",
    "twin.mirror.wing_fraction=0",
]  # fmt: skip


def test_each_neighbour_has_a_permutation_of_the_nodes():
    nodes = shack_hartmann.nodes_by_step(34)
    assert nodes[0, 0].tolist() == list(range(34))
    assert all(sorted(order.tolist()) == list(range(34)) for order in nodes.values())
    # Point reflections of each other: no side is preferred.
    assert all((order + nodes[-i, -j][::-1] == 33).all() for (i, j), order in nodes.items())
    assert len({tuple(order) for order in nodes.values()}) == len(shack_hartmann.NEIGHBOURS)


def test_without_motion_there_is_one_node():
    assert {tuple(order) for order in shack_hartmann.nodes_by_step(1).values()} == {(0,)}


def registration_errors(config, grid, matrix, injected):
    """Errors of the registration, in its units, with free gains of all slopes."""
    model = model_factory(config.calibration.model)(config, grid)
    nominal, derivatives = model.zonal_jacobian(injected)
    motion = [variant.zonal_matrix(injected) - nominal for variant in model.variants()]
    terms = [part @ matrix.m2c / matrix.sigma for part in (nominal, *derivatives, *motion)]
    direction = terms[0] / np.linalg.norm(terms[0], axis=1, keepdims=True)

    def without_gains(values):
        return (values - direction * (values * direction).sum(axis=1, keepdims=True)).ravel()

    found = np.linalg.lstsq(
        np.stack([without_gains(one) for one in terms[1:]], axis=1),
        without_gains(matrix.data / matrix.sigma),
    )[0]
    return found[:5]


@pytest.mark.slow
def test_registration_has_no_bias(monkeypatch):
    injected, config = realisation_config("razor-shwfs", 0, EXACT)
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=2000))
    matrix = decorrelate_columns(run.result.matrix, run.solution.gram, run.solution.variance)
    errors = registration_errors(config, run.result.grid, matrix, injected)
    assert np.abs(errors[:2]).max() < 0.1
    assert np.abs(errors[3:]).max() < 0.015

    def same_motion(n_nodes):
        return dict.fromkeys(shack_hartmann.NEIGHBOURS, np.arange(n_nodes))

    monkeypatch.setattr(shack_hartmann, "nodes_by_step", same_motion)
    assert (registration_errors(config, run.result.grid, matrix, injected)[3:] < -0.025).all()
