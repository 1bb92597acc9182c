"""Scatter of the registration by turbulence states, separated from that by pokes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from escape_sim.models import pyramid_turbulence as module
from escape_sim.models.pyramid_turbulence import turbulence_registration_scatter

STATES, SHAPES, N_SLOPES = 400, 60, 30


@pytest.mark.parametrize(("by_turbulence", "by_pokes"), [(0.3, 0.0), (0.3, 1.0), (0.15, 0.5)])
def test_the_common_part_of_the_shapes_in_one_state_is_due_to_turbulence(
    monkeypatch, by_turbulence, by_pokes
):
    rng = np.random.default_rng(3)
    terms = rng.standard_normal((6, N_SLOPES))
    # One pixel of the phase says how far the state moves the registration, one how far the pokes do, and a
    # third takes the shape; the sensor answers to a shape as if the mirror sat there. Beside a poke the
    # turbulence moves it by more or less.
    screens, pokes, paths = np.zeros((STATES, 2, 2)), np.zeros((SHAPES, 2, 2)), np.zeros((SHAPES, 2, 2))
    screens[:, 0, 0] = by_turbulence * rng.standard_normal(STATES)
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
