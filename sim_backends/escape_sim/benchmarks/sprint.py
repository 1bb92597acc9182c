"""SPRINT against OOPAO's, on the same planted registration, modes and noise."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.benchmark import BenchmarkRow, alternate
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.calibration.modes import karhunen_loeve
from escape_hw.calibration.sprint import sprint
from escape_hw.config.load import load_system
from escape_sim import model as fast_model
from escape_sim import oopao_model
from escape_sim.geometry import actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.oopao_bridge import make_light, mis_registration, oopao, quiet

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: The paper's laboratory case, Table 1.
PLANTED = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
N_MODES = 20
#: White noise on the matrix, relative to the median column, and how often it is drawn.
NOISE, N_DRAWS = 0.15, 5
#: A mirror as it comes: scatter of the actuators' gains, and coupling where the model says 0.4.
GAIN_SCATTER, COUPLING = 0.05, 0.43
#: OOPAO thinks in telescopes and rounds shifts: the same bench a thousand times larger.
_SCALE = 1000.0
#: OOPAO's numbers of the parameters, in the order of ``PARAMETERS``.
_OOPAO_PARAMETERS = (0, 1, 2, 4, 5)


Solver = Callable[[NDArray[np.float64]], Registration]


def run() -> list[BenchmarkRow]:
    """All rows of the stage."""
    config = load_system("razor-shwfs")
    model = fast_model.make_model(config, None)
    m2c = karhunen_loeve(*model.influence_functions(), N_MODES, 0.03)
    peer = Peer(config, m2c)
    who = f"OOPAO {version('OOPAO')}: SPRINT, 6 iterations"
    note = f"{N_MODES} modes, {NOISE:.0%} noise, the paper's registration"
    rows = []
    for label, real in (("ideal mirror", False), ("real mirror", True)):
        ours, theirs = our_matrix(config, m2c, real), peer.matrix(real)
        if not real:
            seconds = alternate(
                lambda: our_solver(config, m2c)(_draws(ours)[0]),  # noqa: B023 - called at once
                lambda: peer.solver()(_draws(theirs)[0]),  # noqa: B023
                rounds=2,
            )
            ours_s, peer_s = seconds
            rows.append(BenchmarkRow("sprint: set-up and solution", ours_s, peer_s, who, "s", "lower", note))
        found = [_errors(our_solver(config, m2c), ours), _errors(peer.solver(), theirs)]
        for what, which, unit in (
            ("shift", slice(0, 2), "% of a sub-aperture"),
            ("rotation", slice(2, 3), "deg"),
            ("scaling", slice(3, 5), "%"),
        ):
            rms = [float(np.sqrt(np.mean(np.square(e[:, which])))) for e in found]
            stage = f"sprint: error of {what}, {label}"
            rows.append(BenchmarkRow(stage, rms[0], rms[1], who, unit, "lower", note))
    return rows


def _draws(matrix: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(1)
    return [matrix + rng.normal(0, _sigma(matrix), matrix.shape) for _ in range(N_DRAWS)]


def _sigma(matrix: NDArray[np.float64]) -> float:
    return NOISE * float(np.median(matrix.std(axis=0)))


def _errors(solver: Solver, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Errors ``(n_draws, 5)`` in the units of the parameters."""
    return np.stack([solver(data).to_array() - PLANTED.to_array() for data in _draws(matrix)])


def _gains(n_act: int, real: bool) -> NDArray[np.float64]:
    scatter = np.random.default_rng(7).standard_normal(n_act)
    return 1 + (GAIN_SCATTER * scatter if real else np.zeros(n_act))


def our_matrix(config: SystemConfig, m2c: NDArray[np.float64], real: bool) -> NDArray[np.float64]:
    """The planted matrix ``(n_slopes, n_modes)`` on the bench's camera, by OOPAO's optics."""
    if real:
        mirror = config.devices.dm.model_copy(update={"coupling": COUPLING})
        config = config.model_copy(update={"devices": config.devices.model_copy(update={"dm": mirror})})
    zonal = oopao_model.make_model(config, None).zonal_matrix(PLANTED)
    return (zonal * _gains(zonal.shape[1], real)) @ m2c


def our_solver(config: SystemConfig, m2c: NDArray[np.float64]) -> Solver:
    """Our SPRINT with the fast model of the design."""
    grid = fast_model.nominal_grid(config)
    model = fast_model.make_model(config, grid)

    def solve(data: NDArray[np.float64]) -> Registration:
        matrix = InteractionMatrix(
            data.astype(np.float32),
            np.full(data.shape, _sigma(data), np.float32),
            m2c,
            grid.valid,
            config.system.name,
            "push-pull",
            True,
        )
        return sprint(matrix, model).registration

    return solve


class Peer:
    """OOPAO's SPRINT on a matrix of its own sensor.

    It gets what it needs to do well: no threshold, six iterations, and a precision that does not
    round the answer away.
    """

    def __init__(self, config: SystemConfig, m2c: NDArray[np.float64]) -> None:
        self._pupil, self._m2c = pupil_geometry(config), m2c
        diameter = config.system.pupil_m * _SCALE
        light = make_light(self._pupil.amplitude, diameter, config.system.wavelength_m)
        self._sub_aperture = self._pupil.sub_aperture_m * _SCALE
        self._place = {
            "telescope": light.telescope,
            "nSubap": self._pupil.n_sub,
            "coordinates": actuator_positions(config) * _SCALE,
            "pitch": pitch_on_pupil(config) * _SCALE,
            "print_dm_properties": False,
        }
        with quiet():
            sensor = oopao().ShackHartmann(
                nSubap=self._pupil.n_sub,
                telescope=light.telescope,
                lightRatio=config.sensor.min_flux,
                threshold_cog=0,
            )
            mirror = oopao().DeformableMirror(mechCoupling=config.devices.dm.coupling, **self._place)
        self._parts = SimpleNamespace(
            tel=light.telescope, ngs=light.source, dm=mirror, wfs=sensor, atm=None, param=None
        )

    def matrix(self, real: bool) -> NDArray[np.float64]:
        """The planted matrix ``(n_slopes, n_modes)`` on OOPAO's own sensor."""
        p = self._parts
        moved = mis_registration(PLANTED, self._sub_aperture)
        with quiet():
            measure = import_module("OOPAO.calibration.InteractionMatrix").InteractionMatrix
            coupling = COUPLING if real else p.dm.mechCoupling
            mirror = oopao().DeformableMirror(mechCoupling=coupling, misReg=moved, **self._place)
            acting = _gains(len(self._m2c), real)[:, None] * self._m2c
            return np.asarray(
                measure(p.ngs, p.tel, mirror, p.wfs, acting, stroke=1e-9, invert=False, nMeasurements=1).D
            )

    def solver(self) -> Solver:
        """OOPAO's SPRINT, set up with its sensitivities."""
        with quiet():
            solver = import_module("OOPAO.SPRINT").SPRINT(
                self._parts,
                SimpleNamespace(modes=self._m2c, extra="KL"),
                n_mis_reg=len(PARAMETERS),
                ind_mis_reg=list(_OOPAO_PARAMETERS),
                mis_registration_zero_point=oopao().MisRegistration(),
            )

        def solve(data: NDArray[np.float64]) -> Registration:
            with quiet():
                solver.estimate(self._parts, data, n_iteration=6, precision=6, display=False, plot=False)
            x, y, rotation, radial, tangential = solver.mis_registration_buffer[-1]
            per_cent = 100 / self._sub_aperture
            return Registration(-per_cent * x, -per_cent * y, rotation, 100 * radial, 100 * tangential)

        return solve
