"""The matrices that a sweep compares: made beforehand, once, or read from files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.errors import ConfigError
from escape_hw.io.fits.matrix import MatrixProduct
from escape_hw.io.run_folder import RunFolder
from escape_hw.paper.experiments import (
    WITH_GAINS,
    CalibrationComparison,
    measure_matrices,
    measure_matrices_on_one_geometry,
    measure_optical_gains,
)
from escape_hw.paper.experiments import with_and_without_optical_gains as with_and_without_optical_gains
from escape_hw.report.tables import METHOD_LABELS
from escape_hw.runtime.procedures.products import add_calibration, add_gains, product_key
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.sweep.design import MatrixVariant


def measure_variants(bench: Bench, *, frames: int, gain_frames: int = 0) -> Procedure[CalibrationComparison]:
    """Push-pull, DO-CRIME and ESCAPE as for the paper's results; on a pyramid with their optical gains.

    Parameters
    ----------
    bench
        An open bench.
    frames
        Frames of the DO-CRIME measurement.
    gain_frames
        Frames per round of the optical gains at most; 0: none are measured. A Shack-Hartmann sensor has
        none to speak of.

    Raises
    ------
    TooFewFrames, CalibrationError, Aborted
        See :func:`~escape_hw.paper.experiments.reproduce_shwfs`.
    """
    result = CalibrationComparison()
    if not gain_frames:
        yield from measure_matrices(bench, frames, result)
        return result
    yield from measure_matrices_on_one_geometry(bench, frames, result)
    if not result.partial:
        yield from measure_optical_gains(bench, gain_frames, result, accuracy=0.03)
    return result


def save_variants(
    folder: RunFolder, record: BenchRecord, measured: CalibrationComparison
) -> list[MatrixVariant]:
    """Save what :func:`measure_variants` made; matrices scaled by optical gains get files of their own.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    saved: dict[str, Path] = {}
    scaled = (
        dict(with_and_without_optical_gains(measured.calibrations, measured))
        if measured.gains is not None
        else dict(measured.calibrations)
    )
    for label, calibration in scaled.items():
        parent = saved.get(label.removesuffix(WITH_GAINS))
        source = {} if parent is None else {"im": parent}
        saved[label] = add_calibration(folder, record, product_key(label), calibration, source)
    if measured.gains is not None:
        add_gains(folder, record, "gains", measured.gains, {"im": saved["ESCAPE"]})
    return [_make_variant(label, path) for label, path in saved.items()]


def read_variants(
    products: Sequence[MatrixProduct], gains: GainsResult | None, scaled_in: Path
) -> list[MatrixVariant]:
    """Arms from files.

    Parameters
    ----------
    products
        The matrices. Two of the same kind are told apart by the names of their files.
    gains
        Optical gains, as ``escape gains`` measures them: every matrix that they are known for is an arm
        with them as well.
    scaled_in
        Folder for the scaled matrices.

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
    arms = [
        MatrixVariant(label, False, product.path.absolute(), product.sha256)
        for label, product in named.items()
    ]
    if gains is None:
        return arms
    scaled = _scale_by_gains({label: product.result for label, product in named.items()}, gains)
    if not scaled:
        raise ConfigError(
            f"the optical gains are those of {gains.method} and {', '.join(gains.comparisons) or 'nothing else'}; "
            f"the matrices are {', '.join(named)}"
        )
    from escape_hw.io.fits.matrix import save_matrix

    for label, calibration in scaled.items():
        path = save_matrix(scaled_in / f"{product_key(label + WITH_GAINS)}.fits", calibration)
        arms.append(_make_variant(label + WITH_GAINS, path))
    return sorted(arms, key=lambda arm: list(named).index(arm.matrix))


def _scale_by_gains(
    known: Mapping[str, CalibrationResult], gains: GainsResult
) -> dict[str, CalibrationResult]:
    from dataclasses import replace

    from escape_hw.calibration.optical_gain.matrix_comparison import scale_matrix
    from escape_hw.calibration.optical_gain.smoothing import clip_gains

    vectors = {METHOD_LABELS.get(gains.method, gains.method): gains.gains, **gains.comparisons}
    found = {}
    for label, one in known.items():
        vector = vectors.get(label) or vectors.get(product_key(label))
        if vector is not None:
            matrix = scale_matrix(one.matrix, clip_gains(vector), vector.best_sigma)
            found[label] = replace(one, matrix=matrix, measured=None)
    return found


def _make_variant(label: str, path: Path) -> MatrixVariant:
    from escape_hw.io.provenance import file_sha256

    matrix = label.removesuffix(WITH_GAINS)
    return MatrixVariant(matrix, matrix != label, path.absolute(), file_sha256(path))
