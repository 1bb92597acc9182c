"""Results of tracking: table of updates, alarms, exchanges of the reconstructor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import CalibrationResult

#: Columns of the table after those of the registration.
_LOOP_COLUMNS = (
    "optical_gain", "optical_gain_sigma", "misfit", "innovation", "noise", "mismatch", "residual_nm",
    "strehl", "strehl_sigma", "exchanged",
)  # fmt: skip
COLUMNS = ("seconds", *PARAMETERS, *(f"{name}_sigma" for name in PARAMETERS), *_LOOP_COLUMNS)

#: Progress metric of the tracker: largest displacement of a point of the mirror on the sensor since the start
#: of tracking, in % of a sub-aperture.
DRIFT = "drift"


@dataclass(frozen=True, slots=True)
class Alarm:
    """A change of the system that a new registration does not explain.

    Parameters
    ----------
    seconds
        Time since the start of tracking.
    kind
        ``jump``, ``misfit``, ``noise``, ``delay``, ``actuator``, ``limit``, ``diverged`` or ``dark``.
    text
        Description and remedy.
    """

    seconds: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Exchange:
    """A proposed or exchanged matrix, with the evidence for it.

    Parameters
    ----------
    seconds
        Time of the proposal.
    accepted
        Whether the loop uses it.
    change
        Change of the registration since that of the matrix in use, by parameter: value and standard error.
    gain
        Change of the mean optical gain, relative, and its standard error.
    mismatch, mismatch_sigma
        Rms relative difference of the two matrices, and its expectation from the errors.
    min_loop_gain, max_loop_gain
        Smallest and largest loop gain of any combination of modes with the matrix in use, relative to the
        nominal one (eigenvalues of ``R_use D_new``); the exchange makes both 1.
    """

    seconds: float
    accepted: bool
    change: dict[str, tuple[float, float]]
    gain: tuple[float, float]
    mismatch: float
    mismatch_sigma: float
    min_loop_gain: float
    max_loop_gain: float


@dataclass(slots=True, eq=False)
class TrackResult:
    """Result of a tracking run.

    Parameters
    ----------
    rows
        One list per column of :data:`COLUMNS`, in that order; NaN where nothing was measured.
    optical_gain, optical_gain_sigma
        Gain of every mode at the end, relative to the matrix at the start ``(n_modes,)``.
    exchanges, alarms
        In chronological order.
    latest
        The last pseudo-synthetic matrix, whether in use or not; ``None`` before the first.
    stable
        False if the loop was opened because it diverged or the sensor went dark.
    start_ns
        Clock of the sensor at ``seconds`` = 0.
    """

    rows: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in COLUMNS})
    optical_gain: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    optical_gain_sigma: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    exchanges: list[Exchange] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    latest: CalibrationResult | None = None
    frames: int = 0
    lost_frames: int = 0
    rate_hz: float = 0.0
    poke: float = 0.0
    stable: bool = True
    partial: bool = False
    start_ns: int = 0

    def __repr__(self) -> str:
        seconds = self.rows["seconds"][-1] if self.rows["seconds"] else 0.0
        accepted = sum(one.accepted for one in self.exchanges)
        words = [
            f"{seconds:.4g} s, {self.frames} frames, {self.lost_frames} lost",
            "stable" if self.stable else "UNSTABLE",
            f"{len(self.exchanges)} matrices proposed, {accepted} exchanged",
            f"{len(self.alarms)} alarms",
        ]
        return f"<{type(self).__name__} {', '.join(words)}{', PARTIAL' if self.partial else ''}>"

    def column(self, name: str) -> NDArray[np.float64]:
        """A column of the table."""
        return np.array(self.rows[name])

    def add(self, **values: float) -> None:
        """Append a row, NaN for missing columns; raises ``ValueError`` for unknown ones."""
        unknown = set(values) - set(self.rows)
        if unknown:
            raise ValueError(f"the table has no columns {', '.join(sorted(unknown))}")
        for name, column in self.rows.items():
            column.append(float(values.get(name, np.nan)))

    def to_csv(self) -> str:
        """The table as text, one line per update."""
        lines = [",".join(COLUMNS)]
        lines += [",".join(f"{v:.6g}" for v in row) for row in zip(*self.rows.values(), strict=True)]
        return "\n".join(lines) + "\n"
