"""Transmission of obscuration, vanes and contamination."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from escape_hw.config.loader import load_system
from escape_hw.config.system import TelescopeSection
from escape_hw.config.twin import TwinAtmosphere, TwinContamination, TwinStar
from escape_hw.pipeline.geometry.obscuration import transmitted_fraction
from escape_sim.optics.pupil import contaminated_pupil, pupil_geometry, pupil_transmission

D, N = 6.5, 60
X = (np.arange(N) - (N - 1) / 2) * D / N


def shadow(**telescope):
    return (1 - transmitted_fraction(TelescopeSection(**telescope), D, X)).sum() * (D / N) ** 2


def test_nothing_in_the_way_takes_nothing():
    assert shadow() == 0


@pytest.mark.parametrize("obscuration", [0.05, 0.2, 0.5])
def test_central_obscuration(obscuration):
    assert shadow(obscuration=obscuration) == pytest.approx(math.pi / 4 * (obscuration * D) ** 2, rel=0.01)


@pytest.mark.parametrize("angle", [0.0, 37.0, 90.0, -120.0])
def test_a_vane_thinner_than_a_sample_takes_its_share(angle):
    # To the edge of the square grid, from the centre outwards.
    length = D / 2 / max(abs(math.cos(math.radians(angle))), abs(math.sin(math.radians(angle))))
    assert shadow(spider_m=0.05, spiders_deg=(angle,)) == pytest.approx(0.05 * length, rel=0.1)


def test_vanes_point_from_x_towards_y():
    share = transmitted_fraction(TelescopeSection(spider_m=0.2, spiders_deg=(90.0,)), D, X)
    rows, columns = np.nonzero(share < 1)
    assert rows.min() >= N // 2 - 1
    assert set(columns) <= {N // 2 - 1, N // 2}
    assert share[N - 1, N // 2] < 0.2


def test_a_vane_needs_a_width():
    with pytest.raises(ValidationError, match="need a width"):
        TelescopeSection(spiders_deg=(0.0,))


def test_the_pupil_of_a_telescope_keeps_the_right_power():
    plain = load_system("razor-shwfs")
    config = load_system(
        "razor-shwfs",
        overrides=["telescope.obscuration=0.3", "sensor.beam_radius_m=inf"],
    )
    bare = load_system("razor-shwfs", overrides=["sensor.beam_radius_m=inf"])
    power = [np.square(pupil_geometry(c).amplitude, dtype=float).sum() for c in (config, bare)]
    assert power[0] / power[1] == pytest.approx(1 - 0.09, abs=0.002)
    assert np.array_equal(
        pupil_geometry(plain).amplitude, contaminated_pupil(plain, np.random.default_rng(0)).amplitude
    )


def contaminated(seed=0, **settings):
    return pupil_transmission(TwinContamination(**settings), D, X, np.random.default_rng(seed))


def inside():
    return np.hypot(X[:, None], X) <= D / 2


def test_a_clean_pupil_passes_everything():
    assert (contaminated() == 1).all()


def test_contaminated_arc():
    share = contaminated(edge_share=0.25, angle_deg=90.0, depth=0.2, transmission=0.4)
    lit = inside()
    part = (share < 1) & lit
    assert set(share[lit]) == {0.4, 1.0}
    # A quarter of a ring from 0.8 to 1 radius, at high rows.
    assert part.sum() / lit.sum() == pytest.approx(0.25 * (1 - 0.64), rel=0.06)
    rows, columns = np.nonzero(part)
    assert rows.min() > N / 2
    assert abs(columns.mean() - (N - 1) / 2) < 0.5


def test_unevenness_has_its_size_and_is_seeded():
    shares = [contaminated(seed, unevenness=0.1)[inside()] for seed in range(20)]
    assert np.mean([s.std() for s in shares]) == pytest.approx(0.1, rel=0.3)
    assert np.array_equal(shares[3], contaminated(3, unevenness=0.1)[inside()])
    assert not np.array_equal(shares[3], shares[4])


def test_an_uneven_edge_cuts_the_rim_only():
    share = contaminated(edge_unevenness=0.05)
    radius = np.hypot(X[:, None], X) / (D / 2)
    cut = (share == 0) & inside()
    assert 0.005 < cut.sum() / inside().sum() < 0.15
    assert radius[cut].min() > 0.8


def test_star_and_sky():
    star = TwinStar(magnitude=10.0, zero_point=25.0, sky_magnitude=20.0, field_arcsec=2.0)
    assert star.electrons(0.01) == pytest.approx(1e6 * 0.01)
    brighter = TwinStar(magnitude=9.0, zero_point=25.0)
    assert brighter.electrons(0.01) / star.electrons(0.01) == pytest.approx(2.5119, rel=1e-4)
    assert star.sky_electrons(0.01) == pytest.approx(100 * math.pi * 0.01)
    assert brighter.sky_electrons(1.0) == 0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"fraction": (0.5, 0.4)}, "sums to 0.9, not 1"),
        ({"speed_m_s": (5.0,)}, "one entry for each of the 2 layers"),
        ({"direction_deg": (5.0, 1.0, 2.0)}, "one entry for each of the 2 layers"),
    ],
)
def test_layers_that_contradict_each_other_are_refused(changes, text):
    good = {
        "r0_m": 0.1, "outer_scale_m": 20.0, "fraction": (0.5, 0.5), "speed_m_s": (5.0, 9.0),
        "direction_deg": (0.0, 90.0),
    }  # fmt: skip
    TwinAtmosphere(**good)
    with pytest.raises(ValidationError, match=text):
        TwinAtmosphere(**{**good, **changes})
