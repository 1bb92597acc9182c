"""Scatter of the registration by turbulence states, separated from that by pokes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from escape_sim.models import pyramid_turbulence as module
from escape_sim.models.pyramid_turbulence import turbulence_registration_scatter

STATES, SHAPES, N_SLOPES = 400, 10, 30


@pytest.mark.parametrize(("by_turbulence", "by_pokes"), [(0.3, 0.0), (0.3, 1.0), (0.15, 0.5)])
def test_the_common_part_of_shapes_of_one_state_is_due_to_turbulence(monkeypatch, by_turbulence, by_pokes):
    rng = np.random.default_rng(3)
    terms = rng.standard_normal((6, N_SLOPES))
    # One pixel of the phase says how far the state moves the registration, one how far the pokes do, and a
    # third takes the shape; the sensor answers to a shape as if the mirror sat there.
    phases = np.zeros((STATES, SHAPES, 2, 2))
    phases[:, :, 0, 0] = by_turbulence * rng.standard_normal((STATES, 1))
    phases[:, :, 0, 1] = by_pokes * rng.standard_normal((STATES, SHAPES))
    influence = np.zeros((1, 2, 2))
    influence[0, 1, 1] = 1.0
    commands = rng.uniform(0.5, 1.5, (STATES, 1, SHAPES))

    def slopes(frame, _pupils):
        return frame[1, 1] * (terms[0] + (frame[0, 0] + frame[0, 1]) * terms[1:].sum(axis=0))

    def jacobian(shape):
        matrix = terms[:, :, None] * shape[0]
        return matrix[0], matrix[1:]

    monkeypatch.setattr(module, "slopes_of_image", slopes)
    optics = SimpleNamespace(wavelength_m=2 * np.pi, frame=lambda phase: phase.astype(float))
    found = turbulence_registration_scatter(optics, None, phases, commands, influence, jacobian)
    # Ten shapes average what the pokes do to a tenth in variance, and no further.
    least = np.sqrt(module._MIN_SHARE * (by_turbulence**2 + by_pokes**2 / SHAPES))
    assert found == pytest.approx(np.full(5, max(by_turbulence, least)), rel=0.2)
    naive = np.sqrt(by_turbulence**2 + by_pokes**2 / SHAPES)
    if by_pokes:
        assert found[0] < 0.9 * naive
