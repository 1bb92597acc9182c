"""The model of a telescope has the illumination measured in the pupil images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.config.loader import load_system
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.optics.pupil import (
    apply_measured_illumination,
    contaminated_pupil,
    pupil_from_images,
    pupil_geometry,
)
from escape_sim.optics.pyramid import PyramidOptics

CONTAMINATED = ("twin.contamination.edge_share=0.28", "twin.contamination.unevenness=0.06")


def seen(amplitude: NDArray[np.float32], offsets: NDArray[np.float64]) -> PyramidPupils:
    """Pupil images of a flat wavefront, their light as a finder sums it."""
    config = load_system("maps-nir")
    pupils = nominal_pupils(config)
    pupils = replace(pupils, centres_px=pupils.centres_px + offsets)
    optics = PyramidModel(config, pupils, turbulence=0.0).optics()
    n = config.sensor.n_sub
    optics = PyramidOptics(
        amplitude,
        float(n),
        config.system.wavelength_m,
        pupils.centres_px,
        (80, 80),
        optics.modulation,
        samples=2,
    )
    image = optics.frame(np.zeros(amplitude.shape, np.float32)).astype(float)
    light = np.sum([image[y : y + n, x : x + n] for x, y in pupils.corners_px], axis=0)
    return replace(pupils, flux=(light / np.percentile(light, 95)).astype(np.float32))


def test_a_contaminated_arc_is_dark_in_the_model() -> None:
    config = load_system("maps-nir", overrides=CONTAMINATED)
    contaminated, design = contaminated_pupil(config, np.random.default_rng(3)), pupil_geometry(config)
    offsets = np.array([[0.3, -0.35], [-0.4, 0.2], [0.25, 0.4], [-0.2, -0.2]])
    found = apply_measured_illumination(design, seen(contaminated.amplitude, offsets))
    light, want = (np.square(pupil.amplitude, dtype=float) for pupil in (found, contaminated))
    # What the images cannot show: the last pixel of the rim, and samples half a pixel wide.
    radius = np.hypot(*np.meshgrid(design.coordinates_m, design.coordinates_m)) / 3.25
    inside = (radius < 0.95) & (radius > 0.35)
    dark, bright = inside & (want < 0.5), inside & (want > 0.8)
    assert dark.sum() > 100
    scale = light[bright].mean() / want[bright].mean()
    assert light[dark].mean() / want[dark].mean() == pytest.approx(scale, rel=0.4)
    even = np.square(design.amplitude, dtype=float)
    assert np.corrcoef(light[inside], want[inside])[0, 1] > 0.7
    assert np.abs(even[dark].mean() - want[dark].mean()) > 0.4
    # What is lit stays lit: the basis is the design's.
    assert np.array_equal(found.lit, design.lit)


def test_an_even_pupil_stays_even() -> None:
    design = pupil_geometry(load_system("maps-nir"))
    found = apply_measured_illumination(design, seen(design.amplitude, np.zeros((4, 2))))
    light, want = (np.square(pupil.amplitude, dtype=float)[design.lit] for pupil in (found, design))
    assert np.std(light / light.mean() - want / want.mean()) < 0.12


def test_a_bench_is_lit_by_its_design() -> None:
    config = load_system("razor-pywfs")
    pupils = nominal_pupils(config)
    dim = replace(pupils, flux=pupils.flux * np.linspace(0.5, 1, 64, dtype=np.float32))
    assert np.array_equal(pupil_from_images(config, dim).amplitude, pupil_geometry(config).amplitude)
