"""The matrices that a sweep compares: measured before the sweep, or read from files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.procedure import Procedure
from escape_hw.bench import Bench
from escape_hw.errors import ConfigError
from escape_hw.io.fits.matrix import MatrixProduct, save_matrix
from escape_hw.io.provenance import file_sha256
from escape_hw.io.run_folder import RunFolder
from escape_hw.report.tables import METHOD_LABELS
from escape_hw.runtime.procedures.calibration_comparison import (
    WITH_GAINS,
    CalibrationComparison,
    measure_matrices,
    measure_optical_gains,
    scale_by_gains,
    with_and_without_optical_gains,
)
from escape_hw.runtime.procedures.products import add_result, product_key
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.sweep.design import MatrixVariant


def measure_variants(bench: Bench, *, frames: int, gain_frames: int = 0) -> Procedure[CalibrationComparison]:
    """Measure the push-pull, DO-CRIME and ESCAPE matrices, and their optical gains.

    ``gain_frames`` are frames per round of the optical gains at most. 0: none are measured, as for a
    Shack-Hartmann sensor, whose optical gains are close to one.

    Raises
    ------
    TooFewFrames, CalibrationError, Aborted
        As :func:`~escape_hw.runtime.procedures.calibration.calibrate_with_method`.
    """
    result = CalibrationComparison()
    yield from measure_matrices(bench, frames, result)
    if gain_frames and not result.partial:
        yield from measure_optical_gains(bench, gain_frames, result, accuracy=0.03)
    return result


def save_variants(
    folder: RunFolder, record: BenchRecord, measured: CalibrationComparison
) -> list[MatrixVariant]:
    """Save measured matrices; those scaled by optical gains get files of their own.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    calibrations = measured.calibrations
    if measured.gains is not None:
        calibrations = dict(with_and_without_optical_gains(calibrations, measured))
    saved: dict[str, Path] = {}
    for label, calibration in calibrations.items():
        parent = saved.get(label.removesuffix(WITH_GAINS))
        source = [] if parent is None else [parent]
        saved[label] = add_result(folder, record, product_key(label), calibration, *source)
    if measured.gains is not None:
        add_result(folder, record, "gains", measured.gains, saved["ESCAPE"])
    return [_make_variant(label, path) for label, path in saved.items()]


def read_variants(
    products: Sequence[MatrixProduct], gains: GainsResult | None, folder: Path
) -> list[MatrixVariant]:
    """Variants from files; several matrices of the same kind are named by their files.

    Every matrix that has optical gains is also compared scaled by them, and then saved in the folder.

    Raises
    ------
    ConfigError
        The gains belong to none of the matrices.
    """
    labels = [METHOD_LABELS.get(one.matrix.method, one.matrix.method) for one in products]
    named = {
        product.path.stem if labels.count(label) > 1 else label: product
        for label, product in zip(labels, products, strict=True)
    }
    if len(named) < len(products):
        raise ConfigError("two of the matrices have files of the same name; rename one")
    vectors = {}
    if gains is not None:
        known = {METHOD_LABELS.get(gains.method, gains.method): gains.gains, **gains.comparisons}
        vectors = {label: known.get(label) or known.get(product_key(label)) for label in named}
    if gains is not None and not any(vectors.values()):
        raise ConfigError(
            f"the optical gains are those of {', '.join((gains.method, *gains.comparisons))}; "
            f"the matrices are {', '.join(named)}"
        )
    variants = []
    for label, product in named.items():
        variants.append(MatrixVariant(label, False, product.path.absolute(), product.sha256))
        vector = vectors.get(label)
        if vector is not None:
            scaled = scale_by_gains(product.result, vector)
            path = save_matrix(folder / f"{product_key(label + WITH_GAINS)}.fits", scaled)
            variants.append(_make_variant(label + WITH_GAINS, path))
    return variants


def _make_variant(label: str, path: Path) -> MatrixVariant:
    matrix = label.removesuffix(WITH_GAINS)
    return MatrixVariant(matrix, matrix != label, path.absolute(), file_sha256(path))
