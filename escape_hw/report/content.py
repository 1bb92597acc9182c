"""What a run left behind, read back from its folder."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import Registration
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate
from escape_hw.errors import ProductError
from escape_hw.io import documents
from escape_hw.io.fits import file as fits_file
from escape_hw.io.fits.gains import KIND_GAINS, load_gains
from escape_hw.io.fits.loop import KIND_PSF, load_loop
from escape_hw.io.fits.matrix import KIND_MATRIX, load_matrix
from escape_hw.io.fits.telemetry import KIND_TELEMETRY
from escape_hw.io.run_folder import RESULT_FILE, read_result
from escape_hw.report.tables import METHOD_LABELS

#: Kinds of products whose results a report and a replay show.
_KINDS_WITH_RESULTS = (KIND_MATRIX, KIND_PSF, KIND_GAINS)


class _Criterion(BaseModel):
    text: str
    met: bool


class _Document(BaseModel):
    """Fields of ``result.json`` that every report reads; others are those of the command."""

    model_config = ConfigDict(extra="allow")

    command: str
    system: str | None
    simulated: bool | None
    criteria: list[_Criterion] | None = None
    injected: dict[str, float] | None = None
    labels: dict[str, dict[str, str]] = {}
    bench: dict[str, Any] = {}


@dataclass(slots=True)
class RunContent:
    """Everything a report shows; see :func:`read_run`.

    By label, as shown: ``calibrations``, ``loops``, ``gains``, and ``names``, the product each calibration
    came from. By product: ``digests`` and ``kinds``, from their headers.
    """

    folder: Path
    document: dict[str, Any]
    calibrations: dict[str, CalibrationResult] = field(default_factory=dict)
    measured_labels: dict[str, str] = field(default_factory=dict)
    columns: dict[str, str] = field(default_factory=dict)
    loops: dict[str, LoopResult] = field(default_factory=dict)
    gains: dict[str, GainsResult] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    config_text: str = ""
    log_text: str = ""

    @property
    def simulated(self) -> bool:
        """True when any device was simulated."""
        return bool(self.document.get("simulated"))

    @property
    def injected(self) -> Registration | None:
        """The registration hidden in the twin, when there was one."""
        values = self.document.get("injected")
        return Registration(**values) if values else None

    @property
    def psf_px(self) -> float | None:
        """lambda/D on the science camera in pixels."""
        value = self.document.get("bench", {}).get("psf_px")
        return float(value) if value else None

    @property
    def full_scale(self) -> int | None:
        """Count at which a pixel of the sensor's camera saturates, where the run has stored it."""
        value = self.document.get("bench", {}).get("full_scale")
        return int(value) if value else None

    @property
    def layout(self) -> NDArray[np.bool_] | None:
        """Map of the actuators."""
        rows = self.document.get("bench", {}).get("layout")
        return np.array([[c == "1" for c in row] for row in rows], bool) if rows else None

    @property
    def places_m(self) -> NDArray[np.float64] | None:
        """Positions of actuators without a grid ``(n_act, 2)``, in metres on the mirror."""
        positions = self.document.get("bench", {}).get("places_m")
        return np.array(positions, float).reshape(-1, 2) if positions else None

    def matrices(self) -> dict[str, InteractionMatrix]:
        """All matrices by label: measured ones before what was computed from them."""
        found: dict[str, InteractionMatrix] = {}
        for label, result in self.calibrations.items():
            if result.measured is not None:
                found.setdefault(self.measured_labels[label], result.measured)
            found.setdefault(label, result.matrix)
        return found

    def estimates(self) -> dict[str, RegistrationEstimate]:
        """Registrations by the heading of their column."""
        return {self.columns[n]: r.registration for n, r in self.calibrations.items() if r.registration}

    def results(self) -> list[CalibrationResult | LoopResult | GainsResult]:
        """All results."""
        return [*self.calibrations.values(), *self.loops.values(), *self.gains.values()]

    def partial(self) -> bool:
        """True when any part of the run was aborted."""
        return bool(self.document.get("partial")) or any(result.partial for result in self.results())


def read_run(folder: Path | str) -> RunContent:
    """Read a run folder: ``result.json`` and every FITS product it names.

    Raises
    ------
    ProductError
        Not a run folder, or a product is missing or damaged.
    """
    document = read_result(folder)
    _check_document(Path(folder) / RESULT_FILE, document)
    run = RunContent(Path(folder).absolute(), document)
    run.config_text, run.log_text = (
        _read_optional_text(run.folder / name) for name in ("config.toml", "run.log")
    )
    labels: Mapping[str, Mapping[str, str]] = document.get("labels", {})
    for name, path in document["products"].items():
        if path.suffix == ".fits":
            _add_product(run, name, path, labels.get(name, {}))
    return run


def _check_document(path: Path, document: Mapping[str, Any]) -> None:
    """Check the fields that every report reads (ProductError: one is missing, or of another kind)."""
    try:
        injected = _Document.model_validate(document).injected or {}
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ProductError(f"{path}: damaged; '{where}': {first['msg']}") from error
    unknown = set(injected) - {one.name for one in fields(Registration)}
    if unknown:
        raise ProductError(f"{path}: damaged; 'injected' has the unknown parameter {min(unknown)!r:.80}")


def read_product(path: Path | str) -> RunContent:
    """Read one FITS product as a run that holds nothing else.

    Raises
    ------
    ProductError
        It is missing, damaged or of a kind without results.
    """
    file = Path(path).absolute()
    hdus, _ = fits_file.read(file)
    header = fits_file.header_dict(hdus)
    if header["KIND"] not in (*_KINDS_WITH_RESULTS, KIND_TELEMETRY):
        raise ProductError(
            f"{file}: its kind is {header['KIND']!r}, which has neither report nor replay; "
            f"'escape show {shlex.quote(str(path))}' summarises it"
        )
    document: dict[str, Any] = {
        **documents.header_fields(
            "show", str(header["SYSTEM"]), bool(header["SIMULATE"]), header.get("SEED")
        ),
        "started_utc": str(header.get("DATE-OBS", header["DATE"])),
        "products": {file.stem: file},
    }
    run = RunContent(file.parent, document, config_text=fits_file.read_text(file, hdus, "CONFIG"))
    _add_product(run, file.stem, file, {})
    for calibration in run.calibrations.values():
        document |= documents.calibration_document(calibration)
    for gains in run.gains.values():
        document |= documents.gains_document(gains)
    for loop in run.loops.values():
        document |= documents.loop_document(loop)
    return run


def _add_product(run: RunContent, name: str, path: Path, label: Mapping[str, str]) -> None:
    """Add a product; of those of other kinds than :data:`_KINDS_WITH_RESULTS`, only digest and kind."""
    hdus, digest = fits_file.read(path)
    kind = hdus[0].header["KIND"]
    run.digests[name], run.kinds[name] = digest, str(kind)
    if kind == KIND_MATRIX:
        result = load_matrix(path).result
        unique = _label(run.calibrations, label, result.matrix.method, name)
        run.calibrations[unique] = result
        run.names[unique] = name
        run.measured_labels[unique] = label.get("measured", METHOD_LABELS["docrime"])
        run.columns[unique] = label.get("column", "" if unique == "ESCAPE" else unique)
    elif kind == KIND_PSF:
        loop = load_loop(path).result
        run.loops[_label(run.loops, label, loop.method, name)] = loop
    elif kind == KIND_GAINS:
        found = load_gains(path).result
        run.gains[_label(run.gains, label, found.method, name)] = found


def _label(used: Mapping[str, object], stated: Mapping[str, str], method: str, name: str) -> str:
    """The stated label of a product, or that of its method; unique among those used."""
    label = stated.get("label") or METHOD_LABELS.get(method, name)
    return label if label not in used else f"{label} ({name})"


def _read_optional_text(path: Path) -> str:
    """A text file of the run; a run that ended early may lack one."""
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
