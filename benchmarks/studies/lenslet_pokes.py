"""Error of the registration by the size of the pokes, on a Shack-Hartmann twin without noise and turbulence.

    python benchmarks/studies/lenslet_pokes.py --out docs/studies/lenslet-pokes

The mirror equals the nominal one, and slopes are computed from images without noise, so that only the
response of the spots to the pokes differs from the synthetic model. Random pokes of all modes, a fraction of
those of the configuration, are regressed as DO-CRIME does, and SPRINT fits the result: with weights averaged
over uniform tilts of each lenslet alone, and with weights averaged over the wavefronts of random pokes of the
same rms as well. Writes ``SYSTEM.jsonl`` with a line per realisation of the pokes
and fraction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from realisation_tables import Line, each_realisation, realisation_numbers, study_parser

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.acquisition.frames import build_interaction_matrix
from escape_hw.calibration.acquisition.pokes import compute_random_amplitudes
from escape_hw.calibration.acquisition.sensor_setup import build_sensor_setup, build_slope_function
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.loader import load_system
from escape_hw.io.provenance import get_git_state
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import get_simulated_bench
from escape_sim.models.shack_hartmann import ShackHartmannModel

#: Fractions of the configured poke.
FRACTIONS = (0.25, 0.5, 1.0)
#: Counts of the brightest pixel on a flat wavefront.
PEAK_COUNTS = 150.0
IDEAL = (
    "devices.dm.influence=gaussian", "twin.mirror.shape=gaussian",
    "twin.mirror.gain_scatter=0", "twin.mirror.width_scatter=0", "twin.mirror.wing_fraction=0",
    "twin.ncpa.rms_m=0", "twin.wfs.fixed_pattern=0",
)  # fmt: skip


class Measurement:
    """Regression of noiseless slopes on random pokes ``(n, n_modes)``."""

    def __init__(self, bench: System, pokes: NDArray[np.float64]) -> None:
        self._twin, self._bench = get_simulated_bench(bench), bench
        height, width = bench.config.devices.wfs.region[:1:-1]
        self._shape, self.m2c = (height, width), build_modal_basis(bench)
        scale = PEAK_COUNTS / self._image(np.zeros(len(self.m2c))).max()
        mean = np.mean([self._image(self.m2c @ poke) for poke in pokes[:300]], axis=0)
        grid = build_sensor_setup(bench, (mean * scale).astype(np.float32)).grid
        slopes_of = build_slope_function(bench, grid)
        slopes = np.array([slopes_of(self._image(self.m2c @ poke) * scale).copy() for poke in pokes], float)
        slopes -= slopes.mean(axis=0)
        response = np.linalg.lstsq(pokes, slopes, rcond=None)[0]
        scatter = (slopes - pokes @ response).var(axis=0)
        sigma = np.sqrt(np.outer(scatter, 1 / np.square(pokes).sum(axis=0)))
        self.matrix: InteractionMatrix = build_interaction_matrix(
            bench, grid, self.m2c, response.T, sigma, "docrime"
        )
        motion = float(np.sqrt(slopes.var(axis=0).mean()))
        if not isinstance(grid, SubApertureGrid):
            raise SystemExit("this study is for Shack-Hartmann sensors")
        rms = float(np.sqrt(np.square(pokes).sum(axis=1).mean()))
        self.grid = grid.with_slope_statistics(motion, rms)

    def _image(self, command: NDArray[np.float64]) -> NDArray[np.float32]:
        image = np.zeros(self._shape, np.float32)
        self._twin.sensor().frame(self._twin.mirror_opd(command), image)
        return image

    def model(self) -> ShackHartmannModel:
        """The model whose response is averaged over tilts of the lenslets."""
        return ShackHartmannModel(self._bench.config, replace(self.grid, pokes=0.0))

    def model_with_pokes(self) -> ShackHartmannModel:
        """The model that SPRINT replaces by the one around random pokes."""
        return ShackHartmannModel(self._bench.config, self.grid)


def run_realisation(
    system: str, number: int, n_pokes: int, overrides: list[str], fractions: tuple[float, ...] = FRACTIONS
) -> Line:
    """Errors of the registration by fraction of the poke, with either model."""
    rng, rows = np.random.default_rng(number), []
    coupling = load_system(system).devices.dm.coupling
    changes = [*IDEAL, f"twin.mirror.coupling={coupling}", *overrides]
    with open_system(system, seed=number, set=changes) as bench:
        injected = bench.config.twin.registration.to_registration()
        amplitude = compute_random_amplitudes(bench, build_modal_basis(bench), bench.config.calibration.poke)
        for fraction in fractions:
            pokes = rng.uniform(-1, 1, (n_pokes, amplitude.size)) * amplitude * fraction
            measured = Measurement(bench, pokes)
            row: Line = {"fraction": fraction, "motion_px": measured.grid.motion_px}
            models = {"nominal": measured.model(), "pokes": measured.model_with_pokes()}
            for label, model in models.items():
                found = sprint(measured.matrix, model, start=injected, coarse_search=False)
                row[label] = {
                    "error": (found.registration.to_array() - injected.to_array()).tolist(),
                    "sigma": found.sigma.tolist(), "gain": found.gain.value,
                }  # fmt: skip
            rows.append(row)
    return {"seed": number, "commit": get_git_state(), "fractions": rows}


def print_table(rows: list[Line]) -> None:
    """Mean error of the shifts in % of a sub-aperture, by fraction and model."""
    for k, fraction in enumerate(FRACTIONS):
        for label in ("nominal", "pokes"):
            errors = np.array([row["fractions"][k][label]["error"][:2] for row in rows])
            print(fraction, label, np.round(errors.mean(axis=0), 3).tolist())


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "revolt-shwfs", 1)
    parser.add_argument("--pokes", type=int, default=1500)
    parser.add_argument("--set", dest="overrides", nargs="*", default=[])
    options = parser.parse_args()
    rows = each_realisation(
        options.out / f"{options.system}.jsonl",
        {"system": options.system, "pokes": options.pokes, "set": options.overrides},
        realisation_numbers(options),
        lambda number: run_realisation(options.system, number, options.pokes, options.overrides),
    )
    print_table(rows)


if __name__ == "__main__":
    main()
