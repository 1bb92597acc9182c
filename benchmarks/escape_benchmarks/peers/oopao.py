"""OOPAO's own SPRINT on OOPAO's own sensor, as a peer."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.config.sensor import PyramidSection
from escape_sim.mirror.influence_functions import actuator_positions, pitch_on_pupil
from escape_sim.models.pyramid import nominal_pupils
from escape_sim.oopao.library import (
    SourceAndTelescope,
    make_source,
    mis_registration,
    oopao_classes,
    suppress_output,
)
from escape_sim.oopao.optics import OOPAOPyramid
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import PupilGeometry, pupil_geometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: OOPAO is made for telescopes and rounds shifts: the bench is modelled a thousand times larger.
_SCALE = 1000.0
#: OOPAO's numbers of the parameters, in the order of ``PARAMETERS``.
_PARAMETERS = (0, 1, 2, 4, 5)


@dataclass(frozen=True, slots=True)
class SolverResult:
    """Registration, and whether the solver reports it as valid."""

    registration: Registration
    valid: bool


@dataclass(frozen=True, slots=True, eq=False)
class MirrorUnderTest:
    """A mirror that may differ from its model: gains of the actuators, and coupling."""

    gains: NDArray[np.float64]
    coupling: float


class OopaoPeer:
    """OOPAO's SPRINT on matrices of its own sensor.

    It gets what it needs to do well: no threshold, and a precision that does not round the answer away.
    Matrices have the signs of our slopes; a pyramid of OOPAO's has the opposite ones.

    Parameters
    ----------
    config
        The system; a pyramid's images stand on a square around the middle of the region.
    m2c
        The modes to use ``(n_act, n_modes)``.
    """

    def __init__(self, config: SystemConfig, m2c: NDArray[np.float64]) -> None:
        self._pupil, self.m2c = pupil_geometry(config), m2c
        light, sensor = _sensor(config, self._pupil)
        # OOPAO's mirror lays its n samples from edge to edge, its wavefront has them at pixel centres.
        n = self._pupil.n_sub * self._pupil.n_pix
        scale = _SCALE * n / (n - 1)
        self._sub_aperture = self._pupil.sub_aperture_m * scale
        self._place = {
            "telescope": light.telescope,
            "nSubap": self._pupil.n_sub,
            "coordinates": actuator_positions(config) * scale,
            "pitch": pitch_on_pupil(config) * scale,
            "print_dm_properties": False,
        }
        with suppress_output():
            mirror = oopao_classes().DeformableMirror(mechCoupling=config.devices.dm.coupling, **self._place)
        self._parts = SimpleNamespace(
            tel=light.telescope, ngs=light.source, dm=mirror, wfs=sensor, atm=None, param=None
        )
        self._sign = -1.0 if config.sensor.kind == "pyramid" else 1.0
        self._solver = None

    name = f"OOPAO {version('OOPAO')}: SPRINT"

    def matrix(
        self, registration: Registration, real: MirrorUnderTest, *, both_ways: bool = True
    ) -> NDArray[np.float64]:
        """The matrix of a mirror under a registration ``(n_slopes, n_modes)`` on OOPAO's own sensor.

        Pushed and pulled, as it is measured; its SPRINT only pushes, which on a pyramid leaves a
        thousandth of curvature at the smallest steps that OOPAO's precision allows.
        """
        p = self._parts
        moved = mis_registration(registration, self._sub_aperture)
        with suppress_output():
            measure = import_module("OOPAO.calibration.InteractionMatrix").InteractionMatrix
            mirror = oopao_classes().DeformableMirror(mechCoupling=real.coupling, misReg=moved, **self._place)
            acting = real.gains[:, None] * self.m2c
            found = measure(
                p.ngs, p.tel, mirror, p.wfs, acting,
                stroke=1e-9, invert=False, nMeasurements=1, single_pass=not both_ways,
            )  # fmt: skip
            return self._sign * np.asarray(found.D)

    def set_up(self) -> None:
        """Calculate the sensitivities about zero."""
        with suppress_output():
            self._solver = import_module("OOPAO.SPRINT").SPRINT(
                self._parts,
                SimpleNamespace(modes=self.m2c, extra="KL"),
                n_mis_reg=len(PARAMETERS),
                ind_mis_reg=list(_PARAMETERS),
                mis_registration_zero_point=oopao_classes().MisRegistration(),
            )

    def solve(self, data: NDArray[np.float64], iterations: int = 6) -> SolverResult:
        """The registration of a matrix, from zero."""
        solver = self._solver
        if solver is None:
            raise RuntimeError("set_up() comes first")
        # Where it diverges it divides by zero; what comes of that is counted, not printed.
        with suppress_output(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            solver.estimate(
                self._parts, self._sign * data, n_iteration=iterations, precision=6, display=False, plot=False
            )
        x, y, rotation, radial, tangential = solver.mis_registration_buffer[-1]
        per_cent = 100 / self._sub_aperture
        found = Registration(-per_cent * x, -per_cent * y, rotation, 100 * radial, 100 * tangential)
        return SolverResult(found, bool(solver.validity_flag))


def _sensor(config: SystemConfig, pupil: PupilGeometry) -> tuple[SourceAndTelescope, Any]:
    """OOPAO's sensor for a design, and the light on it."""
    diameter = config.system.pupil_m * _SCALE
    if not isinstance(config.sensor, PyramidSection):
        light = make_source(pupil.amplitude, diameter, config.system.wavelength_m)
        with suppress_output():
            return light, oopao_classes().ShackHartmann(
                nSubap=pupil.n_sub,
                telescope=light.telescope,
                lightRatio=config.sensor.min_flux,
                threshold_cog=0,
            )
    pupils = nominal_pupils(config)
    pyramid = OOPAOPyramid(
        pupil.amplitude, float(pupil.n_sub), config.system.wavelength_m, pupils.centres_px,
        config.devices.wfs.region[:1:-1], ModulationPath.circle(pupils.modulation), samples=pupil.n_pix,
        diameter_m=diameter,
    )  # fmt: skip
    sensor = pyramid.sensor
    with suppress_output():
        # Its choice of pixels would differ from ours along the rim.
        sensor.userValidSignal = pupils.valid
        sensor.initialization()
        # Otherwise it takes its references relative to those of the choice before.
        sensor.referenceSignal, sensor.referenceSignal_2D = 0, 0
        sensor.wfs_calibration(pyramid.light.source)
    return pyramid.light, sensor
