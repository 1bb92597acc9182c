"""The pyramid's analytic matrices are those of push and pull, of OOPAO, and of frames under turbulence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0
from small_pyramid import configuration

from escape_hw.api.pyramid import PyramidPupils, pupil_boxes
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import DifferentiableModel
from escape_hw.config.loader import load_system
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.atmosphere.von_karman import structure_function
from escape_sim.mirror.mode_surfaces import surface_nodes
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.pyramid_response import PairCoherence, slope_response
from escape_sim.models.pyramid_turbulence import (
    estimate_strength,
    fit_registration_change,
    sample_distances,
    unit_screens,
)
from escape_sim.oopao import models as oopao_model
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pyramid import Prism, PyramidOptics, frequencies

WAVELENGTH = 635e-9
INJECTED = Registration(62.0, -138.0, 0.9, -1.7, 0.8)


# ------------------------------------------------------------------ derivatives by the phase
class Bare:
    """A small pyramid with odd images, in double precision and with nothing but numpy."""

    def __init__(self, samples=1, normalisation="global", radius=3.0):
        n_px, self.grid, self.samples = 12, 40, samples
        n = n_px * samples
        y, x = (np.indices((n, n)) - (n - 1) / 2) / (n / 2)
        r2 = x**2 + y**2
        self.light = np.where(r2 <= 1, np.exp(-r2 / 2.25), 0)
        self.x, self.y = x, y
        centres = np.array([[8.3, 9.0], [29.1, 10.2], [9.0, 30.4], [28.0, 27.7]])
        valid = (self.light**2).reshape(n_px, samples, n_px, samples).sum((1, 3)) > 0.3 * samples**2
        self.pupils = PyramidPupils(
            centres, float(n_px), pupil_boxes(centres, n_px), valid,
            np.zeros((int(valid.sum()), 2), np.float32), valid.astype(np.float32),
            normalisation=normalisation, modulation=radius,
        )  # fmt: skip
        self.prism = Prism((centres + 0.5) * samples - 0.5 - (n - 1) / 2, n)
        circle = ModulationPath.circle(radius, ellipse=0.1)
        self.modulation = ModulationPath(circle.points + np.array([0.1, 0.05]))
        self.normalisation = normalisation

    def slopes(self, phase):
        return slopes_of_image(self.image(phase), self.pupils)

    def differences(self, phase):
        """Light of the right less the left, of the lower less the upper images, and of all four."""
        n, image = len(self.pupils.valid), self.image(phase)
        ul, ur, ll, lr = (image[y : y + n, x : x + n][self.pupils.valid] for x, y in self.pupils.corners_px)
        return np.stack([ur + lr - ul - ll, ll + lr - ul - ur, ul + ur + ll + lr])

    def image(self, phase):
        size = self.grid * self.samples
        n = len(self.light)
        between = np.exp(-2j * np.pi * frequencies(size)[0] * np.arange(n))
        power = np.zeros((size, size))
        for tx, ty in self.modulation.points:
            field = self.light * np.exp(1j * (phase + np.pi * (tx * self.x + ty * self.y)))
            wide = np.fft.fft2(field * between * between[:, None], (size, size)) * self.prism.mask(size)
            power += self.modulation.weight * np.abs(np.fft.ifft2(wide)) ** 2
        return power.reshape(self.grid, self.samples, self.grid, self.samples).sum(axis=(1, 3))

    def response(self, structure=None, interpolation=None, pairs=None, phase=None):
        if pairs is not None:
            pairs = PairCoherence(self.light != 0, self.prism.diameter, self.modulation, pairs)
        return slope_response(
            self.light, self.prism, self.grid * self.samples, self.pupils.corners_px, self.pupils.valid,
            self.modulation, structure, pairs=pairs, interpolation=interpolation, samples=self.samples,
            local=self.normalisation == "local", phase=phase,
        )  # fmt: skip


@pytest.mark.parametrize("static", [None, 0.0])
@pytest.mark.parametrize("normalisation", ["global", "local"])
@pytest.mark.parametrize(("samples", "radius"), [(1, 3.0), (1, 0.0), (2, 2.0)])
def test_derivatives_equal_push_and_pull(samples, radius, normalisation, static):
    # By points of the modulation, and by their coherence with turbulence that is not there.
    bare = Bare(samples, normalisation, radius)
    n = len(bare.light)
    response = bare.response(None if static is None else np.zeros((2 * n - 1, 2 * n - 1)))
    assert response.mean == pytest.approx(bare.slopes(0.0), abs=1e-6)
    rng = np.random.default_rng(0)
    for phase in (bare.x, bare.x * bare.y, rng.standard_normal((n, n))):
        step = 1e-4
        want = (bare.slopes(step * phase) - bare.slopes(-step * phase)) / (2 * step)
        ours = response.phase_derivatives @ phase.ravel()
        assert np.linalg.norm(ours - want) < 3e-6 * np.linalg.norm(want)


@pytest.mark.parametrize("route", ["points", "distances", "pairs"])
def test_derivatives_about_an_aberrated_wavefront_equal_push_and_pull(route):
    bare = Bare()
    n, lit = len(bare.light), int((bare.light > 0).sum())
    still = {
        "points": {},
        "distances": {"structure": np.zeros((2 * n - 1, 2 * n - 1))},
        "pairs": {"pairs": np.zeros((lit, lit), np.float32)},
    }[route]
    mean = 1.5 * bare.x - bare.y**2 + 0.8 * bare.x * bare.y
    response = bare.response(**still, phase=mean)
    assert response.mean == pytest.approx(bare.slopes(mean), abs=1e-6)
    step, phase = 1e-4, np.random.default_rng(0).standard_normal((n, n))
    want = (bare.slopes(mean + step * phase) - bare.slopes(mean - step * phase)) / (2 * step)
    assert np.linalg.norm(response.phase_derivatives @ phase.ravel() - want) < 1e-5 * np.linalg.norm(want)
    flat = bare.response(**still).phase_derivatives @ phase.ravel()
    assert np.linalg.norm(flat - want) > 0.1 * np.linalg.norm(want)


def test_derivatives_by_nodes_include_the_interpolation():
    bare = Bare()
    interpolation = np.random.default_rng(1).standard_normal((12, 7)).astype(np.float32)
    ours = bare.response(interpolation=interpolation).phase_derivatives
    want = np.einsum(
        "kyx,yi,xj->kij",
        bare.response().phase_derivatives.reshape(-1, 12, 12),
        interpolation,
        interpolation,
        optimize=True,
    )
    assert np.abs(ours - want.reshape(len(ours), -1)).max() < 1e-5 * np.abs(want).max()


class Screens:
    """Von Kármán phases over a pupil of one unit, ``ratio`` r0 across, on ``n`` samples."""

    def __init__(self, n, ratio, outer=4.0):
        self.n, self.size = n, 16 * n
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(self.size, 1 / n), np.fft.fftfreq(self.size, 1 / n)))
        self.power = 0.0229 * ratio ** (5 / 3) * (f**2 + outer**-2) ** (-11 / 6) / 16**2

    def __call__(self, number, seed=5):
        rng, n = np.random.default_rng(seed), self.n
        for _ in range(number // 2):
            noise = rng.standard_normal((2, self.size, self.size))
            both = np.fft.fft2((noise[0] + 1j * noise[1]) * np.sqrt(self.power))[:n, :n]
            yield from (both.real, both.imag)

    def structure(self):
        """Their own structure function: they lack what is finer than a sample."""
        covariance = np.fft.fft2(self.power).real
        steps = np.arange(1 - self.n, self.n)
        return 2 * (covariance[0, 0] - covariance[np.ix_(steps, steps)])


def test_screens_have_the_structure_function_of_turbulence():
    ours = Screens(32, 3.0).structure()
    want = structure_function(sample_distances(32, 1 / 32), 1 / 3.0, 4.0)
    assert ours[31, 40:] == pytest.approx(want[31, 40:], rel=0.06)


@pytest.mark.parametrize("ratio", [3.0, 8.0])
@pytest.mark.slow
def test_mean_derivatives_are_those_of_frames_under_turbulence(ratio):
    bare = Bare(radius=1.0)
    screens, number, step = Screens(12, ratio), 200, 1e-2
    mean, static = bare.response(screens.structure()).phase_derivatives, bare.response().phase_derivatives
    modes = np.stack([bare.x, bare.x**2 + bare.y**2, np.cos(6 * bare.x + 4 * bare.y)])
    light, by = 0.0, 0.0
    for phase in screens(number):
        sides = [[bare.differences(phase + s * step * m) for m in modes] for s in (1, -1)]
        light = light + np.mean(sides, axis=(0, 1)) / number
        by = by + np.subtract(*sides) / (2 * step * number)
    # The quotient of the means, term by term.
    norm = light[2].mean()
    seen = (by[:, :2] - light[:2] * by[:, 2:].mean(axis=2, keepdims=True) / norm) / norm
    for k, mode in enumerate(modes):
        ours, rest, measured = mean @ mode.ravel(), static @ mode.ravel(), seen[k].ravel()
        # 200 phases leave 4 %, 1600 leave 0.3 %; without the average the gain would be off by far more.
        assert (measured @ ours) / (ours @ ours) == pytest.approx(1, abs=0.1)
        assert np.linalg.norm(measured - ours) < 0.25 * np.linalg.norm(ours)
        assert (measured @ rest) / (rest @ rest) < (0.85 if ratio > 5 else 1.0)


@pytest.mark.parametrize("path", ["ellipse", "hardly off centre", "no symmetry"])
@pytest.mark.parametrize(("samples", "normalisation"), [(1, "global"), (2, "local")])
def test_all_pairs_give_what_the_convolution_gives(samples, normalisation, path):
    bare = Bare(samples, normalisation)
    bare.modulation = {
        "ellipse": ModulationPath.circle(3.0, ellipse=0.1),
        "hardly off centre": ModulationPath(ModulationPath.circle(3.0).points + 1e-6),
        "no symmetry": ModulationPath(np.array([[1.0, 0.2], [-0.5, 1.4], [0.3, -2.0]])),
    }[path]
    n = len(bare.light)
    structure = Screens(n, 5.0).structure()
    rows, columns = np.nonzero(bare.light)
    pairs = structure[rows[:, None] - rows + n - 1, columns[:, None] - columns + n - 1].astype(np.float32)
    by_pairs, by_distance = bare.response(pairs=pairs), bare.response(structure)
    assert by_pairs.mean == pytest.approx(by_distance.mean, abs=1e-6)
    difference = by_pairs.phase_derivatives - by_distance.phase_derivatives
    assert np.linalg.norm(difference) < 1e-5 * np.linalg.norm(by_distance.phase_derivatives)


@pytest.mark.parametrize("structure", ["even", "uneven"])
@pytest.mark.parametrize("pupil", ["even", "centre sample", "uneven"])
def test_products_with_the_coherence_do_not_depend_on_symmetry(pupil, structure):
    n = 11 if pupil == "centre sample" else 12
    y, x = np.indices((n, n)) - (n - 1) / 2
    lit = np.hypot(x, y) < n / 2
    lit[3, 4] = pupil != "uneven"
    path, phase = ModulationPath.circle(3.0), (x + 0.2 * y)[lit] / n
    difference = np.square(phase[:, None] - phase)
    if structure == "uneven":
        difference *= np.exp(phase[:, None] + phase)
    tilts = np.exp(2j * np.pi / n * np.stack([x[lit], y[lit]], axis=1) @ path.points.T)
    coherence = (tilts.conj() @ tilts.T).real * path.weight * np.exp(-0.5 * difference)
    fields = np.exp(1j * np.random.default_rng(0).standard_normal((3, len(phase)))).astype(np.complex64)
    pairs = PairCoherence(lit, float(n), path, difference.astype(np.float32))
    assert pairs.products(fields) == pytest.approx(fields @ coherence, abs=1e-5 * len(phase))


def test_phases_that_are_not_stationary_are_averaged_over_exactly():
    # One mode, strong on one side of the pupil, whose Gaussian amplitude is integrated by quadrature.
    bare, step = Bare(radius=1.0), 1e-3
    mode, poke = 1.5 * bare.x * (1 + bare.x) * (1 - bare.y), np.cos(3 * bare.x + bare.y)
    lit = bare.light > 0
    pairs = np.square(mode[lit][:, None] - mode[lit]).astype(np.float32)
    light, by = 0.0, 0.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    for amplitude, weight in zip(nodes, weights / weights.sum(), strict=True):
        sides = [bare.differences(amplitude * mode + s * step * poke) for s in (1, -1)]
        light = light + weight * np.mean(sides, axis=0)
        by = by + weight * np.subtract(*sides) / (2 * step)
    norm = light[2].mean()
    want = ((by[:2] - light[:2] * by[2].mean() / norm) / norm).ravel()
    ours = bare.response(pairs=pairs).phase_derivatives @ poke.ravel()
    assert np.linalg.norm(ours - want) < 1e-4 * np.linalg.norm(want)
    without = bare.response().phase_derivatives @ poke.ravel()
    assert np.linalg.norm(without - want) > 0.1 * np.linalg.norm(want)


def test_the_structure_function_is_that_of_the_spectrum():
    # 2 integral of the power spectrum times (1 - cos), over rings.
    r0, outer = 0.1, 2.0
    for r in (0.01, 0.1, 1.0, 10.0):
        f = np.geomspace(1e-4, 1e4 / r, 400_000)
        spectrum = 0.0229 * r0 ** (-5 / 3) * (f**2 + outer**-2) ** (-11 / 6)
        want = np.trapezoid(2 * spectrum * (1 - j0(2 * np.pi * f * r)) * 2 * np.pi * f, f)
        assert structure_function(np.array(r), r0, outer) == pytest.approx(want, rel=5e-3)
    assert structure_function(np.array([0.0]), r0, outer)[0] == 0
    assert structure_function(np.array(0.1), r0) == pytest.approx(6.88, rel=1e-3)


# ------------------------------------------------------------------ matrices
VARIETIES = {
    "modulated": (),
    "still": ("sensor.modulation=0",),
    "local": ("sensor.normalisation=local", "sensor.modulation=5"),
}


@pytest.mark.parametrize("variety", ["modulated", "still", "local"])
@pytest.mark.slow
def test_matrices_equal_those_of_oopao(variety):
    config = configuration(*VARIETIES[variety])
    for registration, width in ((Registration(), 1.0), (INJECTED, 1.1)):
        ours, theirs = (
            module(config, None).zonal_matrix(registration, width)
            for module in (make_fast_model, oopao_model.make_oopao_model)
        )
        assert ours.shape == theirs.shape
        assert np.linalg.norm(ours - theirs) < 2e-5 * np.linalg.norm(theirs)


def test_matrices_equal_push_and_pull_of_the_bench():
    # The bench's own pyramid, 64 pixels across, through the frames that the twin makes.
    config = load_system("razor-pywfs")
    pupils = nominal_pupils(config)
    model = PyramidModel(config, pupils)
    pokes = np.random.default_rng(0).uniform(-1, 1, (model.n_act, 3))
    surfaces, lit, _ = model.influence_functions()
    optics = PyramidOptics(
        np.where(lit, 1.0, 0.0).astype(np.float32) * _beam(config, lit), 64, WAVELENGTH,
        pupils.centres_px, (192, 192), ModulationPath.circle(3.0),
    )  # fmt: skip
    ours = model.modal_matrix(Registration(), pokes)
    for k, poke in enumerate(pokes.T):
        path = np.tensordot(poke, surfaces, 1) * 2 * config.devices.dm.stroke_m
        step = 2e-9 / np.abs(path[lit]).max()
        push, pull = (
            slopes_of_image(optics.frame((s * step * path).astype(np.float32)), pupils) for s in (1, -1)
        )
        want = (push - pull) / (2 * step)
        # What single precision leaves of a step of 2 nm.
        assert np.linalg.norm(ours[:, k] - want) < 4e-4 * np.linalg.norm(want)


def _beam(config, lit):
    y, x = (np.indices(lit.shape) - (len(lit) - 1) / 2) * config.system.pupil_m / len(lit)
    return np.exp(-(x**2 + y**2) / config.sensor.beam_radius_m**2).astype(np.float32)


@pytest.fixture(scope="module")
def model():
    return PyramidModel(configuration(), nominal_pupils(configuration()), turbulence=4.0)


def test_modes_and_derivatives_are_those_of_the_zonal_matrix(model):
    assert isinstance(model, DifferentiableModel)
    m2c = np.random.default_rng(2).standard_normal((model.n_act, 6))
    zonal = model.zonal_matrix(INJECTED, 1.05)
    modal, by = model.modal_jacobian(INJECTED, m2c, 1.05)
    assert np.abs(model.modal_matrix(INJECTED, m2c, 1.05) - zonal @ m2c).max() < 1e-5 * np.abs(modal).max()
    assert np.abs(modal - zonal @ m2c).max() < 1e-5 * np.abs(modal).max()
    zonal_too, zonal_by = model.zonal_jacobian(INJECTED, 1.05)
    assert np.abs(zonal_too - zonal).max() < 1e-5 * np.abs(zonal).max()
    for k, step in enumerate((1.0, 1.0, 0.1, 0.3, 0.3)):
        d = np.eye(5)[k] * step
        sides = [
            model.zonal_matrix(Registration.from_array(INJECTED.to_array() + s * d), 1.05) for s in (1, -1)
        ]
        want = (sides[0] - sides[1]) / (2 * step)
        assert np.abs(zonal_by[k] - want).max() < 2e-3 * np.abs(want).max()
        assert np.abs(by[k] - want @ m2c).max() < 2e-3 * np.abs(want @ m2c).max()
    want = (model.zonal_matrix(INJECTED, 1.06) - model.zonal_matrix(INJECTED, 1.04)) / 0.02
    assert np.abs(zonal_by[5] - want).max() < 2e-3 * np.abs(want).max()
    assert np.abs(by[5] - want @ m2c).max() < 2e-3 * np.abs(want @ m2c).max()


def test_turbulence_takes_response_away_and_not_evenly():
    config = configuration()
    pupils = nominal_pupils(config)
    m2c = np.linalg.qr(np.random.default_rng(3).standard_normal((37, 37)))[0]
    power = [
        np.linalg.svd(PyramidModel(config, pupils, turbulence=t).zonal_matrix(Registration()) @ m2c)[1]
        for t in (0.0, 8.0)
    ]
    ratio = power[1] / power[0]
    assert (ratio < 0.95).all()
    assert np.ptp(ratio) > 0.05


@pytest.mark.parametrize("ratio", [1.0, 4.0, 8.0])
def test_the_motion_of_the_slopes_gives_the_strength(ratio):
    config = configuration()
    model = PyramidModel(config, nominal_pupils(config))
    pupils, optics = nominal_pupils(config), model.optics()
    paths = [p * WAVELENGTH / (2 * np.pi) for p in Screens(16, ratio)(100)]
    slopes = [slopes_of_image(optics.frame(p.astype(np.float32)), pupils) for p in paths]
    motion = float(np.sqrt(np.var(slopes, axis=0).mean()))
    screens = unit_screens(optics.amplitude.shape[0], 4.0)
    assert estimate_strength(optics, replace(pupils, motion=motion), screens) == pytest.approx(
        ratio, rel=0.25
    )
    assert PyramidModel(config, replace(pupils, motion=motion)).turbulence == pytest.approx(ratio, rel=0.25)


def test_without_motion_there_is_no_turbulence():
    config = configuration()
    assert PyramidModel(config, nominal_pupils(config)).turbulence == 0
    # Noise moves slopes too.
    assert PyramidModel(config, replace(nominal_pupils(config), motion=0.01)).turbulence == 0


def test_motion_beyond_the_most_is_as_strong_as_the_most():
    config = configuration()
    pupils = nominal_pupils(config)
    optics = PyramidModel(config, pupils).optics()
    screens = unit_screens(optics.amplitude.shape[0], 4.0)
    most = estimate_strength(optics, replace(pupils, motion=10.0), screens)
    assert 7 < most < 40
    assert estimate_strength(optics, replace(pupils, motion=20.0), screens) == most


def test_variants_of_a_calm_sensor_differ_in_modulation_and_the_place_of_the_images():
    model = PyramidModel(configuration(), nominal_pupils(configuration()))
    here = model.zonal_matrix(INJECTED)
    matrices = [v.zonal_matrix(INJECTED) for v in model.variants()]
    assert len(matrices) == 4
    for one in matrices:
        assert 1e-3 < np.linalg.norm(one - here) / np.linalg.norm(here) < 0.5
    # An ellipse along the axes changes x slopes one way and y slopes the other.
    n = len(here) // 2
    x, y = (np.linalg.norm(matrices[0][s]) / np.linalg.norm(here[s]) for s in (np.s_[:n], np.s_[n:]))
    assert (x - 1) * (y - 1) < 0


def test_the_strength_of_open_turbulence_is_not_fitted_but_part_of_the_error(model):
    assert len(model.variants()) == 2
    sure = configuration("sensor.turbulence_sigma=1e-6")
    error, least = (
        PyramidModel(config, nominal_pupils(config), turbulence=4.0).registration_systematic_error
        for config in (configuration(), sure)
    )
    assert (error > least).all()
    assert least == pytest.approx(np.zeros(5), abs=1e-4)
    # What a fit without the true strength errs by, to first order.
    true = PyramidModel(configuration(), nominal_pupils(configuration()), turbulence=4.0 * 1.4)
    modes = model._basis()
    matrix, derivatives = model.modal_jacobian(Registration(), modes)
    terms = np.concatenate([matrix[None], derivatives[:5]])
    missed = fit_registration_change(terms, true.modal_matrix(Registration(), modes))
    assert error == pytest.approx(np.abs(missed), rel=1e-3, abs=1e-6)


def test_a_sensor_without_turbulence_has_no_variants_of_its_modulation():
    config = configuration("sensor.modulation=0")
    assert len(PyramidModel(config, nominal_pupils(config)).variants()) == 2


def test_images_that_were_misplaced_by_diagonals_are_no_shift():
    config = configuration()
    pupils = nominal_pupils(config)
    diagonals = np.array([1.0, -1.0, -1.0, 1.0])[:, None] * [0.12, -0.08]
    real = PyramidModel(config, replace(pupils, centres_px=pupils.centres_px + diagonals), turbulence=4.0)
    model = PyramidModel(config, pupils, turbulence=4.0)
    modes = np.random.default_rng(2).standard_normal((model.n_act, 60))
    seen = real.modal_matrix(INJECTED, modes)
    here, moved = model.modal_jacobian(INJECTED, modes)

    def shift(beside):
        terms = np.stack([here, *moved, *(v.modal_matrix(INJECTED, modes) - here for v in beside)])
        flat = terms.reshape(len(terms), -1)
        shares = np.linalg.solve(flat @ flat.T, flat @ seen.ravel())
        return shares[1:3] / shares[0], shares[-2:] / shares[0]

    blind, _ = shift([])
    found, apart = shift(model.variants())
    # Left out, a tenth of a pixel passes for half as much of a shift along the other axis.
    assert np.abs(blind).max() > 3
    assert np.abs(found).max() < 0.5
    # The variants stand a tenth of a pixel away.
    assert apart == pytest.approx([1.2, -0.8], abs=0.15)


def test_located_images_are_used_and_not_the_design():
    config = configuration()
    pupils = nominal_pupils(config)
    moved = replace(pupils, centres_px=pupils.centres_px + np.array([[0.4, -0.3], [0, 0], [0, 0.2], [0, 0]]))
    one, two = (PyramidModel(config, p).zonal_matrix(INJECTED) for p in (pupils, moved))
    assert np.linalg.norm(one - two) > 1e-3 * np.linalg.norm(one)


@pytest.mark.parametrize("make", [make_fast_model, oopao_model.make_oopao_model])
def test_pupils_of_another_size_are_refused(make):
    config = configuration()
    pupils = nominal_pupils(config)
    with pytest.raises(CalibrationError, match="n_sub is 16"):
        make(config, replace(pupils, valid=pupils.valid[:-2, :-2]))


def test_boxes_outside_the_grid_are_refused():
    bare = Bare()
    corners = bare.pupils.corners_px + np.array([[0, 0], [20, 0], [0, 0], [0, 0]])
    with pytest.raises(ValueError, match="leave the periodic grid"):
        slope_response(bare.light, bare.prism, 40, corners, bare.pupils.valid, bare.modulation)


@pytest.mark.parametrize(("sigma", "error"), [(0.35, 1e-6), (0.28, 3e-5), (1.0, 1e-6)])
def test_nodes_interpolate_influence_functions(sigma, error):
    x = np.linspace(-2, 2, 64)
    nodes, interpolation = surface_nodes(x, 0.35)
    assert nodes.size < 45
    for centre in np.linspace(-3, 3, 13):
        want = np.exp(-0.5 * ((x - centre) / sigma) ** 2)
        assert interpolation @ np.exp(-0.5 * ((nodes - centre) / sigma) ** 2) == pytest.approx(
            want, abs=error
        )


def test_narrow_influence_functions_need_all_samples():
    x = np.linspace(-2, 2, 64)
    nodes, interpolation = surface_nodes(x, 0.1)
    assert nodes is x
    assert interpolation is None
