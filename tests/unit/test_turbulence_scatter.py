"""Scatter of the registration by turbulence states, separated from that by pokes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from escape_sim.models import pyramid_turbulence as module
from escape_sim.models.pyramid_mean_phase import low_order_phases
from escape_sim.models.pyramid_turbulence import (
    Turbulence,
    sample_distances,
    turbulence_registration_scatter,
)

STATES, SHAPES, N_SLOPES = 400, 60, 30


def test_wavefronts_with_opposite_low_orders_are_turbulence_too() -> None:
    """Structure function of many pairs, which pieces of a cut wavefront would not have."""
    n = 8
    x = np.linspace(-1, 1, n)
    lit = np.hypot(*np.meshgrid(x, x)) <= 1
    turbulence = Turbulence(4.0, sample_distances(n, 1 / n), lit)
    shapes = low_order_phases(x)
    rng = np.random.default_rng(1)
    covariance = -0.5 * turbulence.pair_structure(3.0).astype(float)
    covariance -= covariance.min()
    root = np.linalg.cholesky(covariance + 1e-6 * np.eye(len(covariance)))
    screens = np.zeros((10_000, n, n))
    screens[:, lit] = rng.standard_normal((len(screens), len(root))) @ root.T
    turbulence.phases = lambda strength: screens  # type: ignore[method-assign]
    pairs = turbulence.opposite_phases(3.0, shapes)[:, :, lit]
    first, opposite = pairs[:, 0], pairs[:, 1]
    np.testing.assert_array_equal(first, screens[:, lit])
    structure = [np.square(one[:, :, None] - one[:, None, :40]).mean(axis=0) for one in (first, opposite)]
    assert structure[1] == pytest.approx(structure[0], rel=0.1, abs=1e-4)
    # The coefficients of the low orders are opposite, and the rest is the same.
    design = np.vstack([shapes[:, lit], np.ones(int(lit.sum()))]).T
    fitted, reversed_ = (np.linalg.lstsq(design, one.T, rcond=None)[0][:-1] for one in (first, opposite))
    np.testing.assert_allclose(reversed_, -fitted, atol=1e-6 * np.abs(fitted).max())


def test_what_opposite_wavefronts_change_in_opposite_ways_is_no_scatter(monkeypatch):
    rng = np.random.default_rng(3)
    terms = rng.standard_normal((6, N_SLOPES))
    screens, paths = np.zeros((STATES, 2, 2, 2)), np.zeros((SHAPES, 2, 2))
    known, unknown = 0.5 * rng.standard_normal(STATES), 0.2 * rng.standard_normal(STATES)
    screens[:, 0, 0, 0], screens[:, 1, 0, 0] = unknown + known, unknown - known
    paths[:, 1, 1] = rng.uniform(0.5, 1.5, SHAPES)
    monkeypatch.setattr(
        module, "slopes_of_image",
        lambda frame, _pupils: frame[1, 1] * (terms[0] + frame[0, 0] * terms[1:].sum(axis=0)),
    )  # fmt: skip
    optics = SimpleNamespace(wavelength_m=2 * np.pi, frame=lambda phase: phase.astype(float))
    matrix = terms[:, :, None] * paths[:, 1, 1]
    found = turbulence_registration_scatter(
        optics, None, screens, np.zeros((1, 2, 2)), paths, matrix[0], matrix[1:]
    )
    assert found == pytest.approx(np.full(5, 0.2), rel=0.15)


@pytest.mark.parametrize(("by_turbulence", "by_pokes"), [(0.3, 0.0), (0.3, 1.0), (0.15, 0.5)])
def test_the_common_part_of_the_shapes_in_one_state_is_due_to_turbulence(
    monkeypatch, by_turbulence, by_pokes
):
    rng = np.random.default_rng(3)
    terms = rng.standard_normal((6, N_SLOPES))
    # One pixel of the phase says how far the state moves the registration, one how far the pokes do, and a
    # third takes the shape; the sensor answers to a shape as if the mirror sat there. Beside a poke the
    # turbulence moves it by more or less.
    screens, pokes, paths = np.zeros((STATES, 1, 2, 2)), np.zeros((SHAPES, 2, 2)), np.zeros((SHAPES, 2, 2))
    screens[:, 0, 0, 0] = by_turbulence * rng.standard_normal(STATES)
    pokes[:, 0, 1] = by_pokes * rng.standard_normal(SHAPES)
    paths[:, 1, 1] = rng.uniform(0.5, 1.5, SHAPES)

    def slopes(frame, _pupils):
        moved = frame[0, 0] + frame[0, 1] + frame[0, 0] * frame[0, 1]
        return frame[1, 1] * (terms[0] + moved * terms[1:].sum(axis=0))

    matrix = terms[:, :, None] * paths[:, 1, 1]
    monkeypatch.setattr(module, "slopes_of_image", slopes)
    optics = SimpleNamespace(wavelength_m=2 * np.pi, frame=lambda phase: phase.astype(float))
    found = turbulence_registration_scatter(optics, None, screens, pokes, paths, matrix[0], matrix[1:])
    # What the pokes do by themselves is the same in all states.
    assert found == pytest.approx(np.full(5, by_turbulence), rel=0.25)
    if not by_pokes:
        none = turbulence_registration_scatter(optics, None, screens, pokes[:1], paths, matrix[0], matrix[1:])
        np.testing.assert_allclose(none, found)
