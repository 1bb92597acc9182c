"""Where a screen gets what it shows: a server, or a run that is replayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from escape_hw.remote.state import Arguments, Geometry, LogLine, ProcedureEntry, ProcedurePlan, State
from escape_hw.streams.ring import Sample

__all__ = ["STREAMS", "DataSource", "Sample"]


class DataSource(Protocol):
    """What panels look at. No method waits longer than a moment; none raises when the other side is gone."""

    @property
    def connected(self) -> bool:
        """Whether the other side was heard of lately."""
        ...

    @property
    def state(self) -> State:
        """The newest state."""
        ...

    def latest(self, stream: str, after: int = -1) -> Sample | None:
        """The newest entry of a stream, or ``None`` when there is none newer than ``after``."""
        ...

    def geometry(self) -> Geometry:
        """Where slopes and actuators stand; empty until the sensor was found."""
        ...

    def log_after(self, number: int) -> Sequence[LogLine]:
        """Log lines after a number."""
        ...

    def procedures(self) -> Sequence[ProcedureEntry]:
        """What can be started."""
        ...

    def check(self, procedure: str, arguments: Arguments) -> ProcedurePlan:
        """What a procedure would do.

        Raises
        ------
        ConfigError
            An argument is wrong; says which and the way out.
        """
        ...


#: Streams by name, with the shape and unit of an entry. Frame streams have one entry per frame.
STREAMS: dict[str, str] = {
    # per frame
    "frames": "raw frame of the sensor's camera (rows, columns), counts; meta 'top': where pixels saturate",
    "slopes": "(n_slopes,), pixel",
    "modes": "reconstructed residual (n_modes,), nm rms wavefront; closed loop only",
    "commands": "what the mirror got (n_act,), fraction of full stroke",
    "psf": "science frame (rows, columns), counts",
    # seldom
    "model_psf": "image that the Strehl ratio is measured against (rows, columns), scale of 'psf'",
    "latency_histogram": "counts in the bins of streams.histogram (2, bins): latency, spacing of frames",
    # a few times a second, while something is measured
    "measured_positions": "(n_act,), metres; adaptive secondaries only",
    "matrix": "interaction matrix as measured so far (n_slopes, n_modes), slopes per unit mode",
    "matrix_sigma": "its standard errors (n_slopes, n_modes)",
    "valid": "sub-apertures that the matrix's slopes belong to (rows, columns), 0 or 1",
    "registration": "SPRINT's parameters by iteration (n_iterations, 5): shift x, y [sub-aperture], rotation "
    "[rad], radial, tangential scaling",
    "registration_sigma": "standard errors of the last iteration (5,), same units; NaN: not known yet",
    "step_norm": "norm of SPRINT's step by iteration (n_iterations,)",
    "registration_track": "rows of (seconds, 5 parameters, 5 errors) in tracking (n, 11)",
    "gains": "optical gain by mode (n_modes,)",
    "gains_sigma": "its standard errors (n_modes,)",
    "gains_smooth": "smoothed over modes (n_modes,)",
    "gains_rounds": "gain by round of the bootstrap (n_rounds, n_modes)",
    "residual": "rms residual of the last frames (n,), nm; the newest last",
}
