"""Error of the registration by the response of the spots that the model assumes, on a Shack-Hartmann twin.

    python benchmarks/studies/registration/lenslet_pokes.py --out docs/studies/lenslet-pokes
    python benchmarks/studies/registration/lenslet_pokes.py --out docs/studies/lenslet-pokes --settling 0.17
    python benchmarks/studies/registration/lenslet_pokes.py --out docs/studies/lenslet-pokes --frames 1500

Without ``--frames`` there is neither noise nor turbulence: the mirror equals the nominal one, and slopes are
computed from images without noise, so that only the response of the spots to the pokes differs from the
synthetic model. Random pokes of all modes, a fraction of those of the configuration, are regressed as
DO-CRIME does, and SPRINT fits the result: with weights averaged over uniform tilts of each lenslet alone, and
with weights averaged over the wavefronts of random pokes of the same rms as well. With ``--settling`` the
mirror goes from each poke to the next during the exposure, exponentially with this time constant in
exposures; SPRINT then fits also with the delay that DO-CRIME would find, from which it knows the share of the
poke before. Writes ``SYSTEM.jsonl`` (``SYSTEM-settling.jsonl``) with a line per realisation of the pokes, and
prints the mean error of both shifts.

With ``--frames`` the whole twin, whose seed is the number of the realisation, is measured with DO-CRIME at
shifts of plus and minus a quarter of a sub-aperture, without rotation and scalings. SPRINT fits both matrices
around pokes, with a mirror at rest during the exposure and with one that settles. Writes
``SYSTEM-NAME.jsonl``, and prints half the difference of the errors: the part that changes its sign with the
shift. A realisation takes about two minutes of a core.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.acquisition.frames import build_interaction_matrix
from escape_hw.calibration.acquisition.pokes import compute_random_amplitudes
from escape_hw.calibration.acquisition.sensor_setup import build_sensor_setup, build_slope_function
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.loader import load_system
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import registration_overrides, simulated_config
from escape_hw.runtime.session.system import System, open_system
from escape_sim.devices.true_optical_gains import get_simulated_bench
from escape_sim.models.shack_hartmann import ShackHartmannModel

#: Fractions of the configured poke.
FRACTIONS = (0.25, 0.5, 1.0)
#: Fits by their names in a line: weights around tilts, pokes, and pokes of a mirror that settles.
LABELS = {"nominal": "tilts alone", "pokes": "around the pokes", "settling": "with the poke before"}
#: Shift along x and y with ``--frames``, in % of a sub-aperture, and its names in a line.
SHIFT, SIDES = 25.0, ("plus", "minus")
#: Times during an exposure at which the image of a mirror that settles is computed.
N_TIMES = 8
#: Counts of the brightest pixel on a flat wavefront.
PEAK_COUNTS = 150.0
IDEAL = (
    "devices.dm.influence=gaussian", "twin.mirror.shape=gaussian",
    "twin.mirror.gain_scatter=0", "twin.mirror.width_scatter=0", "twin.mirror.wing_fraction=0",
    "twin.ncpa.rms_m=0", "twin.wfs.fixed_pattern=0",
)  # fmt: skip


class Measurement:
    """Regression of noiseless slopes on random pokes ``(n, n_modes)``.

    ``settling`` is the time constant of the mirror in exposures, 0 for one that is at rest.
    """

    def __init__(self, bench: System, pokes: NDArray[np.float64], settling: float = 0.0) -> None:
        self._twin, self._bench = get_simulated_bench(bench), bench
        height, width = bench.config.devices.wfs.region[:1:-1]
        self._shape, self.m2c = (height, width), build_modal_basis(bench)
        scale = PEAK_COUNTS / self._image(np.zeros(len(self.m2c))).max()
        before = np.roll(pokes, 1, axis=0)
        times = (np.arange(N_TIMES) + 0.5) / N_TIMES
        rest = np.exp(-times / settling) if settling else np.zeros(1)
        images = [self._exposure(*pair, rest) for pair in zip(before, pokes, strict=True)]
        mean = np.mean(images[:300], axis=0)
        grid = build_sensor_setup(bench, (mean * scale).astype(np.float32)).grid
        # The noiseless images are not the integers of a camera.
        slopes_of: Any = build_slope_function(bench, grid)
        slopes = np.array([slopes_of(image * np.float32(scale)).copy() for image in images], np.float64)
        slopes -= slopes.mean(axis=0)
        #: Mean share of the poke before.
        self.overlap = float(rest.mean())
        pokes = np.asarray(pokes + self.overlap * (before - pokes), np.float64)
        response = np.asarray(np.linalg.lstsq(pokes, slopes, rcond=None)[0], np.float64)
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

    def _exposure(
        self, before: NDArray[np.float64], poke: NDArray[np.float64], rest: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        images = [self._image(self.m2c @ (poke + share * (before - poke))) for share in rest]
        return np.asarray(np.mean(images, axis=0), np.float32)

    def matrix_with_delay(self) -> InteractionMatrix:
        """The matrix with the delay that contains the share of the poke before."""
        return replace(self.matrix, metrics={**self.matrix.metrics, "delay_frames": 1 + self.overlap})

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
    system: str,
    number: int,
    n_pokes: int,
    overrides: list[str],
    fractions: tuple[float, ...] = FRACTIONS,
    settling: float = 0.0,
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
            measured = Measurement(bench, pokes, settling)
            row: Line = {"fraction": fraction, "motion_px": measured.grid.motion_px}
            fits = {
                "nominal": (measured.matrix, measured.model()),
                "pokes": (measured.matrix, measured.model_with_pokes()),
            }
            if settling:
                fits["settling"] = (measured.matrix_with_delay(), measured.model_with_pokes())
            for label, (matrix, model) in fits.items():
                found = sprint(matrix, model, start=injected, coarse_search=False)
                row[label] = numbers(found, injected)
            rows.append(row)
    return {"seed": number, "commit": get_git_state(), "fractions": rows}


def numbers(found: RegistrationEstimate, injected: Registration) -> Line:
    """What is saved of a fit."""
    return {
        "error": (found.registration.to_array() - injected.to_array()).tolist(),
        "sigma": found.sigma.tolist(), "gain": found.gain.value,
    }  # fmt: skip


def run_under_turbulence(system: str, number: int, frames: int, overrides: list[str]) -> Line:
    """Errors of the registration at two opposite shifts, by side and response."""
    line: Line = {"seed": number, "commit": get_git_state()}
    for side, shift in zip(SIDES, (SHIFT, -SHIFT), strict=True):
        injected = Registration(shift_x=shift, shift_y=shift)
        config = simulated_config(system, [*overrides, *registration_overrides(injected)], seed=number)
        with System.from_config(config) as bench:
            run = bench.run(docrime_run(bench, frames=frames))
            solution, grid = run.solution, run.result.grid
            matrix = decorrelate_columns(run.result.matrix, solution.gram, solution.variance)
            # With a whole number of frames a mirror is at rest during the exposure.
            at_rest = replace(matrix, metrics={**matrix.metrics, "delay_frames": 1.0})
            options = sprint_options_from_config(config.calibration)
            line[side] = {"delay_frames": run.result.matrix.metrics["delay_frames"]}
            for label, measured in (("pokes", at_rest), ("settling", matrix)):
                found = sprint(
                    measured, bench.model(grid), start=injected, coarse_search=False,
                    covariance=solution.covariance, **options,
                )  # fmt: skip
                line[side][label] = numbers(found, injected)
    return line


def print_odd_parts(rows: list[Line]) -> None:
    """A Markdown table of half the difference of the errors of the shifts in % of a sub-aperture."""
    print("| response | mean | by seed |")
    print("|---|---|---|")
    for label in (one for one in LABELS if one in rows[0][SIDES[0]]):
        plus, minus = (np.array([row[side][label]["error"][:2] for row in rows]) for side in SIDES)
        odd = (plus - minus) / 2
        print(f"| {LABELS[label]} | {_pair(odd.mean(axis=0))} | {'; '.join(map(_pair, odd))} |")


def print_table(rows: list[Line]) -> None:
    """A Markdown table of the mean errors of the shifts in % of a sub-aperture, by poke and response."""
    labels = [one for one in LABELS if one in rows[0]["fractions"][0]]
    print(f"| poke, of the configured | {' | '.join(LABELS[one] for one in labels)} |")
    print("|---|" + "---|" * len(labels))
    for k, fraction in enumerate(FRACTIONS):
        errors = (np.array([row["fractions"][k][one]["error"][:2] for row in rows]) for one in labels)
        print(f"| {fraction:g} | {' | '.join(_pair(one.mean(axis=0)) for one in errors)} |")


def _pair(values: NDArray[np.float64]) -> str:
    return "{:+.3f}, {:+.3f}".format(*values)


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "revolt-shwfs", 1)
    parser.add_argument("--pokes", type=int, default=1500)
    parser.add_argument("--settling", type=float, default=0.0, help="time constant in exposures")
    parser.add_argument("--frames", type=int, help="frames of DO-CRIME under turbulence")
    parser.add_argument("--name", default="turbulence", help="name of that raw table")
    parser.add_argument("--set", dest="overrides", nargs="*", default=[])
    options = parser.parse_args()
    if options.frames is not None:
        rows = each_realisation(
            options.out / f"{options.system}-{options.name}.jsonl",
            {"system": options.system, "frames": options.frames, "set": options.overrides},
            realisation_numbers(options),
            lambda number: run_under_turbulence(options.system, number, options.frames, options.overrides),
        )
        print_odd_parts(rows)
        return
    rows = each_realisation(
        options.out / f"{options.system}{'-settling' if options.settling else ''}.jsonl",
        {
            "system": options.system, "pokes": options.pokes, "set": options.overrides,
            **({"settling": options.settling} if options.settling else {}),
        },
        realisation_numbers(options),
        lambda number: run_realisation(
            options.system, number, options.pokes, options.overrides, settling=options.settling
        ),
    )  # fmt: skip
    print_table(rows)


if __name__ == "__main__":
    main()
