"""What a telescope's mirror leaves of the turbulence, by number of modes: the Strehl that no loop exceeds.

    python benchmarks/studies/turbulence/fitting_error.py --system maps-nir --modes 50 100 200 300

Random screens of the twin's strength are fitted with the configured basis over the lit pupil, with and
without the disabled actuators. Prints the residual in nm, within the mirror's innermost ring and outside,
and the Strehl ratio ``exp(-phase variance)`` (Marechal). Ten seconds on an idle core.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.config.loader import load_system
from escape_sim.mirror.influence_functions import InfluenceFunctions, actuator_positions, pitch_on_pupil
from escape_sim.models.pyramid_turbulence import unit_screens
from escape_sim.optics.pupil import pupil_geometry

#: Wavelength in metres at which the Fried parameter of open-air turbulence is given.
_FRIED_M = 5e-7


def residuals(
    system: str, n_modes: int, disabled: tuple[int, ...] | None = None
) -> tuple[float, float, float, float]:
    """Rms residual in nm: over the pupil, inside the innermost ring, outside it; and the Strehl ratio."""
    config = load_system(system)
    open_air, wavelength = config.twin.atmosphere, config.system.wavelength_m
    if open_air is None:
        raise SystemExit(f"{system} has no open-air turbulence (twin.atmosphere)")
    pupil, diameter = pupil_geometry(config), config.system.pupil_m
    x, lit = pupil.coordinates_m, pupil.lit
    at = actuator_positions(config)
    works = np.ones(len(at), bool)
    works[list(config.devices.dm.limits.disabled if disabled is None else disabled)] = False
    shapes = InfluenceFunctions(at, pitch_on_pupil(config), config.devices.dm.coupling).surfaces(
        Registration(), pupil.sub_aperture_m, x, x
    )[works]
    m2c = karhunen_loeve(shapes, lit, pupil.pixel_m, n_modes, 4 * diameter)
    ratio = diameter / (open_air.r0_m * (wavelength / _FRIED_M) ** 1.2)
    screens = unit_screens(x.size, open_air.outer_scale_m / diameter)[:, lit] * ratio ** (5 / 6)
    residual = _fit_residual(
        screens, np.tensordot(m2c.T, shapes, 1)[:, lit], np.square(pupil.amplitude[lit], dtype=float)
    )
    inside_first_ring = np.hypot(*np.meshgrid(x, x))[lit] < np.hypot(*at.T).min()
    nm = wavelength / (2 * np.pi) * 1e9
    full_pupil, inner, outer = (
        float(np.sqrt(np.mean(np.square(residual[:, part]))))
        for part in (lit[lit], inside_first_ring, ~inside_first_ring)
    )
    return full_pupil * nm, inner * nm, outer * nm, float(np.exp(-(full_pupil**2)))


def _fit_residual(
    screens: NDArray[np.float64], modes: NDArray[np.float64], light: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What a fit of modes and piston, weighted by the light, leaves of screens ``(count, n)``."""
    root = np.sqrt(light)
    basis = np.linalg.qr((np.concatenate([np.ones((1, light.size)), modes]) * root).T)[0]
    seen = screens * root
    return np.asarray((seen - (seen @ basis) @ basis.T) / root)


def main() -> None:
    """Print a line per number of modes."""
    parser = study_parser(__doc__, "maps-nir")
    parser.add_argument("--modes", type=int, nargs="+", default=[50, 100, 200, 300])
    options = parser.parse_args()
    for n_modes in options.modes:
        for name, disabled in (("as configured", None), ("none disabled", ())):
            full_pupil, inner, outer, strehl = residuals(options.system, n_modes, disabled)
            print(
                f"{n_modes} modes, {name}: {full_pupil:.0f} nm (inside the first ring {inner:.0f}, "
                f"outside {outer:.0f}), Strehl {strehl:.2f}"
            )


if __name__ == "__main__":
    main()
