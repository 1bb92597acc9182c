"""Mode matrices and closed-form derivatives of the synthetic model against its zonal matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.synthetic_model import DifferentiableModel, SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_jacobian, modal_matrix, zonal_jacobian
from escape_hw.config.loader import load_system
from escape_sim.mirror.influence_functions import (
    SINGLE_GAUSSIAN,
    InfluenceFunctions,
    actuator_positions,
    pitch_on_pupil,
)
from escape_sim.mirror.mode_surfaces import gaussian_factors, mode_derivatives, mode_surfaces
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import ShackHartmannModel
from escape_sim.optics.pupil import pupil_geometry

#: The paper's laboratory case, and one with everything far out.
PLACES = [Registration(-16.0, -71.0, -0.77, 2.9, 0.0), Registration(310.0, -190.0, 9.0, -6.0, 7.0)]
STEPS = np.array([0.6, 0.6, 0.02, 0.06, 0.06, 0.002])


class Plain:
    """What a third party brings: no more than the protocol asks."""

    def __init__(self, inner: ShackHartmannModel) -> None:
        self.inner, self.name = inner, "plain"
        self.n_act, self.sub_aperture_m = inner.n_act, inner.sub_aperture_m

    def influence_functions(self):
        return self.inner.influence_functions()

    def zonal_matrix(self, registration, width=1.0):
        return self.inner.zonal_matrix(registration, width)

    def variants(self) -> Sequence[Plain]:
        return []


@pytest.fixture(scope="module")
def model() -> ShackHartmannModel:
    return make_fast_model(load_system("razor-shwfs"), None)


def difference(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def central(model, place, width):
    here = np.append(place.to_array(), width)
    out = []
    for k, step in enumerate(STEPS):
        plus, minus = (here + s * step * np.eye(6)[k] for s in (1, -1))
        both = [model.zonal_matrix(Registration.from_array(p[:5]), p[5]) for p in (plus, minus)]
        out.append((both[0] - both[1]) / (2 * step))
    return np.stack(out)


@pytest.mark.parametrize("n_modes", [1, 5, 12, 13, 60])
@pytest.mark.parametrize("place", PLACES, ids=["paper", "far"])
def test_few_modes_and_many_equal_the_zonal_product(model, place, n_modes):
    m2c = np.random.default_rng(n_modes).standard_normal((model.n_act, n_modes))
    found = model.modal_matrix(place, m2c, 1.1)
    assert found.dtype == np.float64
    assert difference(found, model.zonal_matrix(place, 1.1) @ m2c) < 3e-6
    assert difference(model.modal_jacobian(place, m2c, 1.1)[0], model.zonal_matrix(place, 1.1) @ m2c) < 3e-6


@pytest.mark.parametrize("width", [1.0, 1.2])
@pytest.mark.parametrize("place", PLACES, ids=["paper", "far"])
def test_derivatives_equal_central_differences(model, place, width):
    m2c = np.random.default_rng(0).standard_normal((model.n_act, 7))
    want = central(model, place, width)
    zonal, by_parameter = model.zonal_jacobian(place, width)
    assert difference(zonal, model.zonal_matrix(place, width)) < 3e-6
    modal = model.modal_jacobian(place, m2c, width)[1]
    for k, name in enumerate((*PARAMETERS, "width")):
        assert difference(by_parameter[k], want[k]) < 3e-5, name
        assert difference(modal[k], want[k] @ m2c) < 3e-5, name


def test_a_plain_model_gets_the_same_by_differences(model):
    plain = Plain(model)
    assert isinstance(plain, SyntheticModel)
    assert not isinstance(plain, DifferentiableModel)
    assert isinstance(model, DifferentiableModel)
    m2c = np.random.default_rng(0).standard_normal((model.n_act, 7))
    for ours, theirs in (
        (modal_matrix(model, PLACES[0], m2c), modal_matrix(plain, PLACES[0], m2c)),
        *zip(modal_jacobian(model, PLACES[0], m2c), modal_jacobian(plain, PLACES[0], m2c), strict=True),
        *zip(zonal_jacobian(model, PLACES[0], 1.1), zonal_jacobian(plain, PLACES[0], 1.1), strict=True),
    ):
        assert ours.shape == theirs.shape
        assert difference(ours, theirs) < 1e-3


@pytest.mark.parametrize("profile", [SINGLE_GAUSSIAN, ((0.7, 1.0), (0.3, 1.7))], ids=["one", "two"])
def test_surfaces_of_modes_and_their_derivatives_equal_those_of_the_actuators(profile):
    config = load_system("razor-shwfs")
    pupil = pupil_geometry(config, 4)
    x, y = pupil.coordinates_m, pupil.coordinates_m[:50]
    d, place = pupil.sub_aperture_m, PLACES[0]

    def influence(width):
        return InfluenceFunctions(
            actuator_positions(config), pitch_on_pupil(config), config.devices.dm.coupling, width,
            profile=profile,
        )  # fmt: skip

    m2c = np.random.default_rng(3).standard_normal((97, 4))

    def surfaces(values):
        all_of_them = influence(values[5]).surfaces(Registration.from_array(values[:5]), d, x, y)
        return np.einsum("ayx,am->yxm", all_of_them, m2c)

    here = np.append(place.to_array(), 1.1)
    factors = gaussian_factors(influence(1.1), place, d, x, y, np.float64)
    assert difference(mode_surfaces(factors, m2c), surfaces(here)) < 1e-12
    both = mode_derivatives(factors, m2c)
    assert difference(both[:, :, 0], surfaces(here)) < 1e-12
    for k, step in enumerate(np.diag(STEPS)):
        want = (surfaces(here + step) - surfaces(here - step)) / (2 * STEPS[k])
        assert difference(both[:, :, 1 + k], want) < 1e-5, k


def test_unequal_actuators_have_no_closed_form():
    positions = np.zeros((3, 2))
    for odd in ({"gain": np.ones(3)}, {"width": np.ones(3)}):
        with pytest.raises(ValueError, match="equal width and gain"):
            gaussian_factors(
                InfluenceFunctions(positions, 1.0, 0.4, **odd), Registration(), 1.0, np.ones(2), np.ones(2)
            )
