"""Error of the registration of a calibration, as `escape calibrate` makes it, over random realisations.

    python benchmarks/studies/registration/registration_errors.py --system razor-pywfs --frames 1000 \\
        --realisations 20
    python benchmarks/studies/registration/registration_errors.py --system maps-nir --frames 1500 \\
        --contaminated 0.28
    python benchmarks/studies/registration/registration_errors.py --system razor-shwfs --dm97 --first 1000

Each realisation is a twin with all its imperfections, shifted by up to a sub-aperture, turned by up to two
degrees and scaled by up to 4 %. On a telescope ``--contaminated`` is the share of the circumference that dirt
covers: 0.28, to a fifth of the radius, are a tenth of the pupil, and 0 is a clean and evenly lit one. With
``--dm97`` the mirror is drawn anew in every realisation, as measured ALPAO DM97-15 mirrors are, and the
nominal one has an exponential profile, as on the RAZOR systems without it. Realisations below 1000 are for
development; no constant and no method is ever chosen on those from 1000 on, which are for validation. Writes
``realisations-SYSTEM-NAME.jsonl``: appends one line per realisation; realisations already in the file are
skipped. Prints rms error, mean error and normalised chi-squared of those that converged; with --dm97 on a
lenslet sensor the mean of what the pseudo-synthetic matrix leaves of a noise-free one, in %; on a pyramid
the rms error of the images' mean place in pixels. A realisation takes about half a minute on an idle core.
"""

from __future__ import annotations

import numpy as np

from escape_benchmarks.matrix_agreement import remaining
from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.results import CalibrationResult
from escape_hw.config.sensor import PyramidSection
from escape_hw.config.system import SystemConfig
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System


def with_measured_mirror(config: SystemConfig) -> SystemConfig:
    """The configuration with a mirror that is drawn as measured ALPAO DM97-15 mirrors are."""
    twin, devices = config.twin, config.devices
    true = twin.mirror.model_copy(
        update={
            "shape": "exponential", "coupling": None, "wing_fraction": 0.0, "gain_scatter": 0.075,
            "width_scatter": 0.02,
        }
    )  # fmt: skip
    nominal = devices.dm.model_copy(update={"influence": "exponential", "coupling": 0.42})
    return config.model_copy(
        update={
            "twin": twin.model_copy(update={"mirror": true}),
            "devices": devices.model_copy(update={"dm": nominal}),
        }
    )


def run_realisation(system: str, number: int, frames: int, overrides: list[str], dm97: bool) -> Line:
    """Calibrate one realisation, and compare with what was injected."""
    injected, config = realisation_config(system, number, overrides)
    if dm97:
        config = with_measured_mirror(config)
    with System.from_config(config) as bench:
        found = bench.calibrate("escape", frames=frames)
        agreement = matrix_error(bench, found) if dm97 and config.sensor.kind == "shack-hartmann" else None
    estimate, grid = found.registration, found.grid
    if estimate is None:
        raise RuntimeError("the run ended before a registration was found")
    row = {
        "seed": config.system.seed, "commit": get_git_state(),
        "converged": estimate.converged, "outcome": estimate.outcome, "model_fits": estimate.model_fits,
        "warnings": list(estimate.warnings), "notes": list(estimate.notes), "chi2": estimate.chi2,
        "injected": injected.to_array().tolist(),
        "error": (estimate.registration.to_array() - injected.to_array()).tolist(),
        "sigma": estimate.sigma.tolist(), "gain": estimate.gain.value, "matrix_error": agreement,
    }  # fmt: skip
    if isinstance(grid, PyramidPupils):
        true = np.add(config.sensor_as(PyramidSection).pupils_px, config.twin.pyramid.centre_offsets_px)
        row["images_px"] = (grid.centres_px - true).mean(axis=0).tolist()
        row["images_sigma_px"] = grid.centre_sigma_px
    return row


def matrix_error(bench: System, found: CalibrationResult) -> float:
    """What a matrix leaves of the noise-free one of the calm bench, relative to that, in %.

    That one is measured by push-pull with the source; the variance of its noise is subtracted.
    """
    calm = bench.calibrate("push-pull", grid=found.grid).matrix
    noise = np.sum(np.square(calm.sigma, dtype=float)) / np.sum(np.square(calm.data, dtype=float))
    share = remaining(calm.data.astype(float), found.matrix.data.astype(float))
    return 100 * float(np.sqrt(max(share**2 - noise, 0.0) / (1 - noise)))


def contamination_overrides(share: float) -> list[str]:
    """Overrides for dirt on a share of the circumference; with none the pupil is evenly lit, too."""
    uneven = (0.06, 0.02) if share else (0.0, 0.0)
    names = ("edge_share", "unevenness", "edge_unevenness")
    return [f"twin.contamination.{name}={value}" for name, value in zip(names, (share, *uneven), strict=True)]


def print_table(rows: list[Line]) -> None:
    """Print the statistics of the realisations that converged."""
    converged_rows = [row for row in rows if row["converged"]]
    suffix = "; statistics of the converged realisations:" if converged_rows else ""
    unfit = sum(row.get("model_fits") is False for row in converged_rows)
    flagged = f", {unfit} of which the model does not fit" if unfit else ""
    print(f"{len(rows)} realisations, {len(converged_rows)} converged{flagged}{suffix}")
    if not converged_rows:
        return
    errors, sigmas = (np.array([row[key] for row in converged_rows]) for key in ("error", "sigma"))
    statistics = {
        "rms": np.sqrt(np.mean(np.square(errors), axis=0)),
        "mean": errors.mean(axis=0),
        "+-": errors.std(axis=0, ddof=1) / np.sqrt(len(errors)) if len(errors) > 1 else np.full(5, np.nan),
        "largest": np.abs(errors).max(axis=0),
        "chi2": np.mean(np.square(errors / sigmas), axis=0),
    }
    if converged_rows[0].get("matrix_error") is not None:
        statistics["matrix"] = np.array([np.mean([row["matrix_error"] for row in converged_rows])])
    if "images_px" in converged_rows[0]:
        statistics["images"] = np.sqrt(
            np.mean(np.square([row["images_px"] for row in converged_rows]), axis=0)
        )
    for name, values in statistics.items():
        print(f"{name:7s}", *(f"{value:8.3f}" for value in values))


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "razor-pywfs", 20)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--set", dest="overrides", nargs="*", default=[])
    parser.add_argument("--contaminated", type=float)
    parser.add_argument("--dm97", action="store_true")
    parser.add_argument("--name", default="bundled")
    options = parser.parse_args()
    overrides = options.overrides
    if options.contaminated is not None:
        overrides = overrides + contamination_overrides(options.contaminated)
    rows = each_realisation(
        options.out / f"realisations-{options.system}-{options.name}.jsonl",
        {"system": options.system, "frames": options.frames, "set": overrides, "dm97": options.dm97},
        realisation_numbers(options),
        lambda number: run_realisation(options.system, number, options.frames, overrides, options.dm97),
        lambda row: str(np.round(row["error"], 3).tolist()),
    )
    print_table(rows)


if __name__ == "__main__":
    main()
