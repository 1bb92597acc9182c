"""The matrices that a sweep compares: made beforehand, once, or read from files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from escape_hw.api.gains import GainsResult
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.errors import ConfigError
from escape_hw.io.fits import MatrixProduct
from escape_hw.io.run_folder import RunFolder
from escape_hw.report.tables import METHOD_LABELS
from escape_hw.runtime.keep import keep_calibration, keep_gains, key_of
from escape_hw.runtime.records import BenchRecord
from escape_hw.runtime.reproduce import Comparison, three_matrices
from escape_hw.runtime.reproduce_pywfs import WITH_GAINS, find_gains, shared_geometry_matrices
from escape_hw.runtime.reproduce_pywfs import with_and_without_gains as pairs
from escape_hw.runtime.sweep.plan import Arm


def make_arms(bench: Bench, *, frames: int, gain_frames: int = 0) -> Procedure[Comparison]:
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
        See :func:`~escape_hw.runtime.reproduce.reproduce_shwfs`.
    """
    result = Comparison()
    if not gain_frames:
        yield from three_matrices(bench, frames, result)
        return result
    yield from shared_geometry_matrices(bench, frames, result)
    if not result.partial:
        yield from find_gains(bench, gain_frames, result, accuracy=0.03)
    return result


def keep_arms(folder: RunFolder, record: BenchRecord, made: Comparison) -> list[Arm]:
    """Save what :func:`make_arms` made; matrices scaled by optical gains get files of their own.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    saved: dict[str, Path] = {}
    scaled = dict(pairs(made.calibrations, made)) if made.gains is not None else dict(made.calibrations)
    for label, calibration in scaled.items():
        parent = saved.get(label.removesuffix(WITH_GAINS))
        source = {} if parent is None else {"im": parent}
        saved[label] = keep_calibration(folder, record, key_of(label), calibration, source)
    if made.gains is not None:
        keep_gains(folder, record, "gains", made.gains, {"im": saved["ESCAPE"]})
    return [_arm(label, path) for label, path in saved.items()]


def read_arms(products: Sequence[MatrixProduct], gains: GainsResult | None, scaled_in: Path) -> list[Arm]:
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
    arms = [Arm(label, False, product.path.absolute(), product.sha256) for label, product in named.items()]
    if gains is None:
        return arms
    scaled = _scaled({label: product.result for label, product in named.items()}, gains)
    if not scaled:
        raise ConfigError(
            f"the optical gains are those of {gains.method} and {', '.join(gains.beside) or 'nothing else'}; "
            f"the matrices are {', '.join(named)}"
        )
    from escape_hw.io.fits import save_matrix

    for label, calibration in scaled.items():
        path = save_matrix(scaled_in / f"{key_of(label + WITH_GAINS)}.fits", calibration)
        arms.append(_arm(label + WITH_GAINS, path))
    return sorted(arms, key=lambda arm: list(named).index(arm.matrix))


def _scaled(known: Mapping[str, CalibrationResult], gains: GainsResult) -> dict[str, CalibrationResult]:
    from dataclasses import replace

    from escape_hw.calibration.gain_smoothing import usable
    from escape_hw.calibration.optical_gain import scaled_matrix

    vectors = {METHOD_LABELS.get(gains.method, gains.method): gains.gains, **gains.beside}
    found = {}
    for label, one in known.items():
        vector = vectors.get(label) or vectors.get(key_of(label))
        if vector is not None:
            matrix = scaled_matrix(one.matrix, usable(vector), vector.best_sigma)
            found[label] = replace(one, matrix=matrix, measured=None)
    return found


def _arm(label: str, path: Path) -> Arm:
    from escape_hw.io.provenance import sha256_of

    matrix = label.removesuffix(WITH_GAINS)
    return Arm(matrix, matrix != label, path.absolute(), sha256_of(path))
