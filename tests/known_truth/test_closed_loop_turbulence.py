"""A pyramid in closed loop: what the modes leave of the turbulence, and the mean response under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_pyramid import configuration

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.pyramid_turbulence import Turbulence, sample_distances, unit_screens

#: Pupil diameters over r0, and fraction of the amplitude of the modes that the loop leaves.
STRENGTH, LEFT = 12.0, 0.15


class Loop:
    """Frozen phases of a loop on the small pyramid, its slopes, and the geometry with their statistics."""

    def __init__(self) -> None:
        self.config = configuration()
        self.pupils = nominal_pupils(self.config)
        flat = PyramidModel(self.config, self.pupils, turbulence=0.0)
        self.optics, surfaces = flat.optics(), flat.influence_functions()[0]
        lit = flat.influence_functions()[1]
        modes = np.tensordot(flat._basis().T, surfaces, 1)[:, lit].T
        screens = unit_screens(len(lit), 4.0)
        # Other phases than those of the model: seen from all sides.
        seen = [turned for screen in screens for turned in (screen.T, screen[::-1], screen[:, ::-1].T)]
        self.phases = np.array(seen) * STRENGTH ** (5 / 6)
        inside = self.phases[:, lit]
        inside -= inside.mean(axis=1, keepdims=True)
        basis = np.linalg.qr(modes - modes.mean(axis=0))[0]
        self.phases[:, lit] = inside - (1 - LEFT) * (inside @ basis) @ basis.T
        statistics = SlopeStatistics(self.pupils.n_slopes)
        for phase in self.phases:
            statistics.add(self.slopes(phase).astype(np.float32))
        geometry = statistics.annotate_geometry(self.pupils, closed=True)
        assert isinstance(geometry, PyramidPupils)
        self.geometry = geometry

    def slopes(self, phase: NDArray[np.float64]) -> NDArray[np.float64]:
        path = phase * (self.config.system.wavelength_m / (2 * np.pi))
        return slopes_of_image(self.optics.frame(path.astype(np.float32)), self.pupils)

    def response(self, shape: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean derivative of the slopes by the amplitude of a phase ``(n, n)``."""
        step = 0.02 / shape.std() * shape
        both = [self.slopes(phase + step) - self.slopes(phase - step) for phase in self.phases]
        return np.asarray(np.mean(both, axis=0) * shape.std() / 0.04)


@pytest.fixture(scope="module")
def loop() -> Loop:
    return Loop()


def test_the_strength_and_what_the_loop_leaves_are_found(loop: Loop) -> None:
    model = PyramidModel(loop.config, loop.geometry)
    assert model.turbulence == pytest.approx(STRENGTH, rel=0.15)
    assert model._phases.left == pytest.approx(LEFT, rel=0.25)
    # A model of the open loop takes the small motion for weak turbulence.
    assert PyramidModel(loop.config, replace(loop.geometry, residual_tilt=0.0)).turbulence < STRENGTH / 2


def test_the_structure_of_pairs_is_that_of_what_modes_leave() -> None:
    n, lit = 16, np.hypot(*np.indices((16, 16)) - 7.5) < 8
    modes = np.stack(
        [np.indices((n, n))[0], np.indices((n, n))[1], np.square(np.indices((n, n)) - 7.5).sum(0)]
    )
    turbulence = Turbulence(4.0, sample_distances(n, 1 / n), lit, modes.astype(float))
    turbulence.left = LEFT
    found = turbulence.pair_structure(STRENGTH)
    assert found is not None
    # Whole turbulence of many states, of which the modes take their share.
    between = turbulence.structure(STRENGTH)
    rows, columns = np.nonzero(lit)
    covariance = 100 - between[rows[:, None] - rows + n - 1, columns[:, None] - columns + n - 1] / 2
    rng = np.random.default_rng(0)
    states = np.linalg.cholesky(covariance) @ rng.standard_normal((len(rows), 4000))
    basis = np.linalg.qr(np.vstack([modes[:, lit], np.ones(len(rows))]).T)[0]
    states -= (1 - LEFT) * basis @ (basis.T @ states)
    pairs = rng.integers(len(rows), size=(2, 500))
    want = np.mean(np.square(states[pairs[0]] - states[pairs[1]]), axis=1)
    assert found[tuple(pairs)] == pytest.approx(want, rel=0.12, abs=1e-3)
    opened = Turbulence(4.0, sample_distances(n, 1 / n), lit)
    assert (opened.stationary, turbulence.stationary) == (True, False)
    assert opened.pair_structure(STRENGTH) == pytest.approx(200 - 2 * covariance, rel=1e-5, abs=1e-4)


def test_a_loop_that_stands_at_a_tilt_is_found(loop: Loop) -> None:
    # References are the mean slopes of a wavefront with this tilt in lambda/D, under what the loop leaves.
    tilt = np.array([0.5, -0.8])
    n = loop.phases.shape[1]
    y, x = (np.indices((n, n)) - (n - 1) / 2) / n
    tilted = [loop.slopes(phase + 2 * np.pi * (tilt[0] * x + tilt[1] * y)) for phase in loop.phases]
    references = np.mean(tilted, axis=0).reshape(2, -1).T.astype(np.float32)
    geometry = replace(loop.geometry, references=references).with_slope_statistics(
        loop.geometry.motion, residual_tilt=loop.geometry.residual_tilt, mean=np.zeros(2 * len(references))
    )
    model = PyramidModel(loop.config, geometry)
    lit = model._pupil.lit
    terms = np.stack([np.ones_like(x), x, y], axis=2)[lit]
    assert model.mean_phase is not None
    found = np.linalg.lstsq(terms, model.mean_phase[lit])[0][1:] / (2 * np.pi)
    assert found == pytest.approx(tilt, abs=0.08)
    for variant in model.variants():
        assert variant.mean_phase is model.mean_phase


def test_the_mean_response_has_the_size_of_frames(loop: Loop) -> None:
    closed, opened = (
        PyramidModel(loop.config, geometry)
        for geometry in (loop.geometry, replace(loop.geometry, residual_tilt=0.0))
    )
    m2c, stroke_rad = closed._basis(), 4 * np.pi * loop.config.devices.dm.stroke_m
    shapes = np.tensordot(m2c.T, closed.influence_functions()[0], 1)
    shapes *= stroke_rad / loop.config.system.wavelength_m
    want = np.stack([loop.response(shape) for shape in shapes], axis=1)

    def gain(model: PyramidModel) -> float:
        found = model.modal_matrix(Registration(), m2c)
        return float(np.vdot(found, want) / np.vdot(found, found))

    assert gain(closed) == pytest.approx(1.0, abs=0.06)
    assert gain(opened) < 0.75
