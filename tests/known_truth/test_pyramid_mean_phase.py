"""The mean wavefront of a run is found in the mean slopes, and the model is that about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_pyramid import configuration

from escape_hw.api.registration import Registration
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.pyramid_mean_phase import low_order_phases
from escape_sim.models.pyramid_turbulence import unit_screens

STRENGTH = 5.0
#: Coefficients of the mean wavefront in radians at the rim: tilts, focus and astigmatisms.
MEAN = np.array([2.4, -1.6, 1.0, 1.8, -1.2, 0.0, 0.0, 0.0, 0.0])
#: Rms phase of a mirror shape in radians.
STEP = 0.02


class Run:
    """Mean slopes of frames about a mean wavefront, and their response to three mirror shapes.

    Every turbulent phase is taken with both signs, so that the mean wavefront is known exactly.
    """

    def __init__(self):
        self.config = configuration()
        pupils = nominal_pupils(self.config)
        calm = PyramidModel(self.config, pupils)
        self._optics, self._pupils = calm.optics(), pupils
        surfaces, self.lit, _ = calm.influence_functions()
        n = len(self.lit)
        x = (np.arange(n) - (n - 1) / 2) / (n / 2)
        self.mean_phase = np.tensordot(MEAN, low_order_phases(x), 1)
        self._radians = 2 * np.pi / self.config.system.wavelength_m
        turbulence = STRENGTH ** (5 / 6) * unit_screens(n, 4.0)
        states = [self.mean_phase + sign * screen for screen in turbulence for sign in (1, -1)]
        self.pupils = pupils.with_slope_statistics(
            0.3, mean=np.mean([self.slopes(state) for state in states], axis=0)
        )
        self.pokes = np.random.default_rng(0).standard_normal((calm.n_act, 3))
        shapes = np.tensordot(self.pokes.T, surfaces, 1) * 2 * self.config.devices.dm.stroke_m * self._radians
        scale = STEP / shapes[:, self.lit].std(axis=1)
        self.pokes *= scale
        shapes *= scale[:, None, None]
        self.response = np.stack(
            [np.mean([self.slopes(s + p) - self.slopes(s - p) for s in states], axis=0) / 2 for p in shapes],
            axis=1,
        )

    def slopes(self, phase):
        path = np.where(self.lit, phase, 0.0) / self._radians
        return slopes_of_image(self._optics.frame(path.astype(np.float32)), self._pupils)

    def model_response(self, pupils):
        model = PyramidModel(self.config, pupils, turbulence=STRENGTH)
        return model.modal_matrix(Registration(), self.pokes)


@pytest.fixture(scope="module")
def run():
    return Run()


def test_the_mean_wavefront_is_found_in_the_mean_slopes(run):
    found = PyramidModel(run.config, run.pupils, turbulence=STRENGTH).mean_phase
    assert found is not None
    difference = (found - run.mean_phase)[run.lit]
    assert np.std(difference) < 0.08 * np.std(run.mean_phase[run.lit])


def test_the_response_is_that_about_the_mean_wavefront(run):
    flat = run.model_response(replace(run.pupils, mean_low_orders=None))
    change = run.model_response(run.pupils) - flat
    # The share of the change that the frames show.
    assert np.vdot(change, run.response - flat) / np.vdot(change, change) == pytest.approx(1, abs=0.25)


def test_the_mean_slopes_do_not_depend_on_the_references(run):
    rng = np.random.default_rng(1)
    mean, references = rng.normal(0, 0.1, run.pupils.n_slopes), run.pupils.references
    moved = rng.normal(0, 0.1, references.shape).astype(np.float32)
    one = replace(run.pupils, references=references).with_slope_statistics(0.3, mean=mean)
    other = replace(run.pupils, references=references + moved).with_slope_statistics(
        0.3, mean=mean - moved.T.ravel()
    )
    assert one.mean_low_orders == pytest.approx(other.mean_low_orders, abs=1e-6)
    assert np.abs(one.mean_low_orders).max() > 1e-3


def test_a_calm_sensor_has_no_mean_wavefront(run):
    assert PyramidModel(run.config, run.pupils, turbulence=0.0).mean_phase is None
