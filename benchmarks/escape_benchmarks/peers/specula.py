"""SPECULA's SPRINT, with synim as its model, as a peer where it is installed."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.peers.oopao import SolverResult
from escape_hw.api.registration import Registration
from escape_sim.oopao.library import suppress_output
from escape_sim.optics.pupil import pupil_geometry

if TYPE_CHECKING:
    from escape_hw.api.synthetic_model import SyntheticModel
    from escape_hw.config.system import SystemConfig

#: Why the peer is missing, for the table.
MISSING = "SPECULA is not installed; pip install 'escape-hw[bench-specula]'"


def specula_peer(config: SystemConfig, m2c: NDArray[np.float64], model: SyntheticModel) -> SpeculaPeer | None:
    """The peer, or ``None`` where it is not installed."""
    try:
        version("specula")
    except PackageNotFoundError:
        return None
    return SpeculaPeer(config, m2c, model)


@contextmanager
def _ignore_empty_subapertures() -> Iterator[None]:
    """Sub-apertures without light make synim average nothing, whose warning is suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


class SpeculaPeer:
    """SPECULA's ``SprintShSynim`` on matrices of synim.

    Its estimation loop is called with a given matrix, without its simulation. It supports
    shifts, rotation and one magnification; its anamorphosis divides by zero at its own start. It gets
    the gain of 1, with which it needs fewest iterations, and a threshold that lets it finish.

    Parameters
    ----------
    config
        The system.
    m2c
        The modes to use ``(n_act, n_modes)``.
    model
        Gives the influence functions.
    """

    def __init__(self, config: SystemConfig, m2c: NDArray[np.float64], model: SyntheticModel) -> None:
        # The back end must be chosen before anything else of SPECULA's is imported.
        logging.getLogger("specula").setLevel(logging.ERROR)
        with suppress_output():
            import_module("specula").init(-1, precision=0)
            kind: Any = import_module("specula.processing_objects.sprint_sh_synim").SprintShSynim
        surfaces, _, pixel = model.influence_functions()
        pupil = pupil_geometry(config)
        lit = pupil.lit.reshape(pupil.n_sub * 4, 2, -1, 2)[:, 0, :, 0]
        self._pixels = surfaces.shape[1] / pupil.n_sub
        mask = lit.astype(float)
        flux = np.square(pupil.amplitude, dtype=float)
        flux = flux.reshape(pupil.n_sub, pupil.n_pix, pupil.n_sub, pupil.n_pix).sum(axis=(1, 3))
        valid = flux >= config.sensor.min_flux * np.percentile(flux[flux > 0], 95)
        self._sprint = one = kind.__new__(kind)
        one.xp, one.dtype, one.logger = np, np.float64, logging.getLogger("specula")
        one.pup_diam_m, one.pupil_mask = pixel * surfaces.shape[1], mask
        one.ifunc_3d = np.ascontiguousarray(np.einsum("ayx,am->yxm", surfaces, m2c))
        one.dm = SimpleNamespace(mask=np.ones_like(mask))
        one.source = SimpleNamespace(polar_coordinates=(0.0, 0.0), height=float("inf"))
        one.wfs = SimpleNamespace(subap_on_diameter=pupil.n_sub, subap_wanted_fov=4.0)
        one.idx_valid_sa, one.apply_absolute_slopes = np.argwhere(valid), False
        one.nmodes, one.n_params = m2c.shape[1], 4
        one.perturbations = {0: (1.0, "x"), 1: (1.0, "y"), 2: (0.1, "rotation"), 3: (0.01, "magnification")}
        one.estimated_intmat = SimpleNamespace(nslopes=2 * int(valid.sum()), intmat=None)
        one.integration_gain, one.forgetting_factor, one.convergence_threshold = 1.0, 1.0, 1e-6

    @property
    def name(self) -> str:
        """Name and versions."""
        return f"SPECULA {version('specula')} with synim {version('synim')}"

    def matrix(self, registration: Registration) -> NDArray[np.float64]:
        """Matrix of synim ``(n_slopes, n_modes)``; the two scalings must be equal."""
        self._sprint.misreg_params = self._in_pixels(registration)
        with _ignore_empty_subapertures():
            return np.asarray(self._sprint._compute_nominal_im())  # noqa: SLF001

    def solve(self, data: NDArray[np.float64], iterations: int = 6) -> SolverResult:
        """The registration of a matrix, from zero; both scalings are its magnification."""
        self._sprint.misreg_params = np.zeros(4)
        self._sprint.max_iterations = iterations
        with _ignore_empty_subapertures():
            self._sprint._iterative_estimation(data)  # noqa: SLF001
        x, y, rotation, magnification = (float(v) for v in self._sprint.misreg_params)
        per_cent = 100 / self._pixels
        found = Registration(x * per_cent, y * per_cent, rotation, 100 * magnification, 100 * magnification)
        return SolverResult(found, bool(np.isfinite(found.to_array()).all()))

    def _in_pixels(self, registration: Registration) -> NDArray[np.float64]:
        x, y, rotation, radial, _ = registration.to_array()
        return np.array([x / 100 * self._pixels, y / 100 * self._pixels, rotation, radial / 100])
