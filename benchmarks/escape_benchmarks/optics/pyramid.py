"""Frames and matrices of pyramid sensors, against OOPAO and against what the transforms alone cost."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pyfftw
from numpy.typing import NDArray

from escape_benchmarks.optics.frames import oopao_frame, twin_frame
from escape_benchmarks.rows import frame_rate_row, time_row
from escape_hw.api.benchmark import BenchmarkRow, time_alternately
from escape_hw.api.registration import Registration
from escape_hw.config.loader import load_system
from escape_hw.config.sensor import PyramidSection
from escape_sim.models.factory import make_fast_model
from escape_sim.oopao import models as oopao_model
from escape_sim.oopao.library import oopao_classes, suppress_output
from escape_sim.oopao.optics import OOPAOPyramid
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pyramid import WORKERS, PyramidOptics

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

_SYSTEM, _TELESCOPE = "razor-pywfs", "maps-nir"
_WAVELENGTH = 635e-9
_RADIUS = 3.0
_CORNERS = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """A pyramid: pixels across an image, samples across a pixel, and where the images stand."""

    name: str
    n_px: int
    samples: int
    centres_px: NDArray[np.float64]
    grid: int


def _square(name: str, n_px: int, samples: int, grid: int) -> _Case:
    """Images on a perfect square around the middle of the grid, two pixels apart."""
    return _Case(name, n_px, samples, (grid - 1) / 2 + _CORNERS * (n_px + 2) / 2, grid)


def pyramid_rows(peer: str) -> list[BenchmarkRow]:
    """Rows of the stage ``optics`` about pyramids, for that name and version of OOPAO."""
    config = load_system(_SYSTEM, overrides=["twin.substeps=1", "twin.loss_probability=0"])
    found = np.add(config.sensor_as(PyramidSection).pupils_px, config.twin.pyramid.centre_offsets_px)
    cases = (
        _square("square of 64 px images", 64, 1, 132),
        _Case("razor-pywfs images", 64, 1, found, 192),
        _square("square of 30 px images, 4 samples each", 30, 4, 64),
    )
    rows = [_kernel(case, peer) for case in cases]
    bench = "64 px images on 192 x 192 camera pixels, 3 lambda/D, 20 points"
    rows.append(_frames("optics: pyramid twin frames", config, peer, bench))
    telescope = load_system(_TELESCOPE, overrides=["twin.loss_probability=0"])
    note = "336 actuators, 3 layers, 30 px images on 80 x 80 camera pixels, 60 samples, 3 lambda/D, 20 points"
    rows.append(_frames(f"optics: {_TELESCOPE} twin frames", telescope, peer, note))
    return [*rows, _matrix(config, peer)]


def _frames(stage: str, config: SystemConfig, peer: str, note: str) -> BenchmarkRow:
    """Whole frames, from the command to the quantised image."""
    times = time_alternately(twin_frame(config), oopao_frame(config), seconds=3.0)
    return frame_rate_row(stage, times, f"{peer}: atmosphere, mirror, sensor, noise", note)


def _matrix(config: SystemConfig, peer: str) -> BenchmarkRow:
    """The matrix of all actuators under a registration."""
    start = time.perf_counter()
    ours = make_fast_model(config, None)
    built_s = time.perf_counter() - start
    theirs = oopao_model.make_oopao_model(config, None)
    at = Registration(62.0, -138.0, 0.9, -1.7, 0.8)
    a, b = ours.zonal_matrix(at), theirs.zonal_matrix(at)
    agreement = float(np.linalg.norm(a - b) / np.linalg.norm(b))
    times = time_alternately(
        lambda: ours.zonal_matrix(at), lambda: theirs.zonal_matrix(at), seconds=1.0, rounds=1
    )
    note = f"relative difference {agreement:.1e}; ours built in {built_s:.2f} s, for all registrations"
    name = f"{peer}: mirror and sensor, push and pull"
    return time_row("optics: pyramid zonal matrix", times, name, "ms", note)


def _kernel(case: _Case, peer: str) -> BenchmarkRow:
    """Sensor only, phase to frame."""
    n = case.n_px * case.samples
    y, x = (np.indices((n, n)) - (n - 1) / 2) / (n / 2)
    beam = np.where(x**2 + y**2 <= 1, 1.0, 0.0)
    geometry = (
        (beam / np.sqrt(beam.sum())).astype(np.float32), case.n_px, _WAVELENGTH, case.centres_px,
        (case.grid, case.grid), ModulationPath.circle(_RADIUS),
    )  # fmt: skip
    fast = PyramidOptics(*geometry, samples=case.samples, grid_px=case.grid)
    slow = OOPAOPyramid(*geometry, samples=case.samples, grid_px=case.grid)
    path = (1e-7 * np.random.default_rng(0).standard_normal((n, n))).astype(np.float32)
    a, b = fast.frame(path), slow.frame(path)
    agreement = float(np.abs(a - b).max() / b.max())
    with suppress_output():
        given = oopao_classes().OPD_map(path.astype(float))

    def theirs() -> None:
        with suppress_output():
            slow.light.source**slow.light.telescope * given * slow.sensor

    times = time_alternately(lambda: fast.frame(path), theirs, seconds=2.0, rounds=5)
    floor_s, what = _arithmetic_floor(n, case.grid * case.samples, fast)
    note = (
        f"{n} samples on {case.grid * case.samples}, {len(fast.modulation.points)} points; "
        f"relative difference {agreement:.0e}; {what} alone take {floor_s / times[0]:.0%} of the time"
    )
    return frame_rate_row(f"optics: pyramid, {case.name}", times, f"{peer} Pyramid", note)


def _arithmetic_floor(n: int, size: int, optics: PyramidOptics) -> tuple[float, str]:
    """Seconds that nothing but the arithmetic of a frame takes, and what that is."""
    if optics.uses_matrix_products:
        h = n // 2
        once_s = 0.0
        for left, right in (((2, n, h), (2, h, size // 2)), ((2, size // 2, h), (2, h, size))):
            a, b = np.ones(left, np.complex64), np.ones(right, np.complex64)
            once_s += time_alternately(partial(np.matmul, a, b), None, seconds=0.3)[0]
        what = "matrix products"
    else:
        source, out = (pyfftw.zeros_aligned((size, size), np.complex64) for _ in range(2))
        plan = pyfftw.FFTW(source, out, axes=(1,), flags=("FFTW_ESTIMATE",))
        once_s = time_alternately(plan.execute, None, seconds=0.3)[0] * (n + 3 * size) / size
        what = "transforms"
    return once_s * len(optics.modulation.points) / WORKERS, what
