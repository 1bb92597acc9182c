"""Protocol of data sources for displays, and the names of the streams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from escape_hw.deprecation import renamed_text, warn_renamed
from escape_hw.io.night_log import NightEntry
from escape_hw.remote.state import Geometry, LogLine, ProcedureEntry, State
from escape_hw.streams.ring import Sample

__all__ = ["STREAMS", "DataSource", "Sample"]


class DataSource(Protocol):
    """A server or a replayed run. No method blocks for long or raises when the source is disconnected."""

    @property
    def connected(self) -> bool:
        """Whether the source has sent a message within the last seconds."""
        ...

    @property
    def state(self) -> State:
        """The newest state."""
        ...

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry of a stream; ``None`` when there is none newer than ``after``."""
        ...

    def geometry(self) -> Geometry:
        """Positions of the sub-apertures and actuators; empty before the sensor was measured."""
        ...

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines with a larger number."""
        ...

    def night_after(self, number: int) -> Sequence[NightEntry]:
        """Entries of the night log with a larger number."""
        ...

    def procedures(self) -> Sequence[ProcedureEntry]:
        """The procedures with their parameters."""
        ...


#: Streams by name, with the shape and unit of an entry. Frame streams have one entry per frame.
STREAMS: dict[str, str] = {
    # per frame
    "frames": "raw frame of the sensor's camera (rows, columns), counts; meta 'full_scale': saturation",
    "slopes": "(n_slopes,), pixel",
    "residual_modes": "reconstructed residual (n_modes,), nm rms wavefront; closed loop only",
    "commands": "command of the mirror (n_act,), fraction of full stroke",
    "psf": "science frame (rows, columns), counts; meta 'full_scale': saturation",
    # on change
    "model_psf": "reference PSF of the Strehl ratio (rows, columns), scale of 'psf'",
    "latency_histogram": "counts in the bins of streams.timing (2, bins): latency, frame interval",
    # a few times a second, while something is measured
    "measured_positions": "(n_act,), metres; adaptive secondaries only",
    "matrix": "interaction matrix measured so far (n_slopes, n_modes), slopes per unit mode",
    "matrix_sigma": "its standard errors (n_slopes, n_modes)",
    "valid": "valid sub-apertures of the matrix (rows, columns), 0 or 1",
    "registration": "SPRINT's parameters by iteration (n_iterations, 5): shift x, y [sub-aperture], rotation "
    "[rad], radial, tangential scaling",
    "registration_sigma": "standard errors of the last iteration (5,), same units; NaN while unknown",
    "step_norm": "norm of SPRINT's step by iteration (n_iterations,)",
    "registration_track": "rows of (seconds, 5 parameters, 5 errors) in tracking (n, 11)",
    "gains": "optical gain by mode (n_modes,)",
    "gains_sigma": "its standard errors (n_modes,)",
    "gains_smooth": "smoothed over modes (n_modes,)",
    "gains_rounds": "gain by round of the bootstrap (n_rounds, n_modes)",
    "residual": "rms residual of the last frames (n,), nm; the newest last",
}

#: Names of version 0.1.0 and their present names.
RENAMED_STREAMS = {"modes": "residual_modes"}


def present_stream(name: str) -> str:
    """The present name of a stream; an old name is reported with a deprecation message."""
    present = RENAMED_STREAMS.get(name, name)
    if present != name:
        warn_renamed(renamed_text(f"the stream '{name}'", f"'{present}'"))
    return present
