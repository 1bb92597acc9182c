"""Results of the procedures; every number with its standard error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.influence import InfluenceProfile
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS, UNITS, Registration
from escape_hw.api.representation import line_html, short_repr, table_html
from escape_hw.api.sensor import SensorGeometry
from escape_hw.deprecation import renamed_members


@dataclass(frozen=True, slots=True, eq=False)
class ActuatorCorrections:
    """Fitted differences between the actuators and the nominal ones.

    They are posterior means under priors of zero mean, so a correction that the data hardly determine is
    nearly zero (best linear unbiased prediction; Robinson 1991).

    Parameters
    ----------
    gain, gain_sigma
        Relative gain of every actuator beyond the common one, and its standard error ``(n_act,)``.
    width
        Relative width of every influence function beyond the common one ``(n_act,)``.
    shape
        Coefficients of the common shape of the influence functions
        (:class:`~escape_hw.calibration.sprint.influence_shape.InfluenceShape`).
    position
        Position of every actuator along x and y beyond the nominal one, in % of a sub-aperture ``(2,
        n_act)``.
    width_sigma, position_sigma
        Standard errors ``(n_act,)`` and ``(2, n_act)``; 0 in products of earlier versions.
    shape_covariance
        Covariance of the common width and the coefficients of the shape ``(1 + n, 1 + n)``; ``None`` in
        products of earlier versions.
    """

    gain: NDArray[np.float64]
    gain_sigma: NDArray[np.float64]
    width: NDArray[np.float64]
    shape: NDArray[np.float64]
    position: NDArray[np.float64]
    width_sigma: NDArray[np.float64] | float = 0.0
    position_sigma: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 1)))
    shape_covariance: NDArray[np.float64] | None = None
    __repr__ = short_repr


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value, its standard error and its unit."""

    value: float
    sigma: float
    unit: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As a dictionary for JSON."""
        return {"value": self.value, "sigma": self.sigma, "unit": self.unit}


@renamed_members(delay="delay_frames")
@dataclass(frozen=True, slots=True, eq=False)
class TemporalResponse:
    """Response of the sensor to a step of the mirror, in frames.

    ``weights[l]`` is the share of the final response that appears in the ``l``-th frame after the
    command was sent; they sum to 1. ``delay_frames`` is the mean of that distribution.
    """

    weights: NDArray[np.float64]
    sigma: NDArray[np.float64]
    __repr__ = short_repr

    @property
    def delay_frames(self) -> float:
        """Mean delay in frames."""
        return float(np.arange(self.weights.size) @ self.weights)


@dataclass(frozen=True, slots=True, eq=False)
class SprintIteration:
    """One iteration of SPRINT: parameters, gain, relative step norm and reduced chi-squared."""

    registration: Registration
    gain: float
    step_norm: float
    chi2: float


@dataclass(frozen=True, slots=True, eq=False)
class GoodnessOfFit:
    """Residual of a fitted matrix relative to its noise.

    Parameters
    ----------
    fits
        Whether the residual is what noise and priors allow, apart from a small misfit.
    misfit
        Rms of the residual beyond the noise, relative to that of the matrix.
    by_sub_aperture, by_actuator
        Rms residual of every sub-aperture ``(n_valid,)`` and every actuator ``(n_act,)`` in standard errors:
        1 for noise alone.
    """

    fits: bool
    misfit: float
    by_sub_aperture: NDArray[np.float64]
    by_actuator: NDArray[np.float64]
    __repr__ = short_repr


#: Ratio to the median beyond which a residual is outlying.
_OUTLIER = 3.0


def find_outliers(rms: NDArray[np.float64]) -> list[int]:
    """Indices of sub-apertures or actuators with an outlying rms residual ``(n,)``, the worst first."""
    limit = _OUTLIER * max(float(np.median(rms)), 1e-300)
    return [k for k in np.argsort(-rms).tolist() if rms[k] > limit]


def describe_outcome(converged: bool, model_fits: bool | None) -> str:
    """The outcome of SPRINT in words, the same wherever it is shown.

    Parameters
    ----------
    converged, model_fits
        As in :class:`RegistrationEstimate`.
    """
    if not converged:
        return "NOT converged"
    return "converged, but the model does not fit" if model_fits is False else "converged"


@renamed_members(measured="parameters", departures="actuator_corrections")
@dataclass(frozen=True, slots=True, eq=False)
class RegistrationEstimate:
    """Registration estimated by SPRINT.

    Parameters
    ----------
    covariance
        ``(5, 5)`` in the order and units of ``PARAMETERS``, systematic errors of the model included.
    width
        Width of the influence functions relative to nominal.
    warnings
        Reasons not to use the estimate; ``converged`` is false if there are any.
    notes
        Further remarks, such as parameters with strongly correlated errors.
    actuator_corrections
        Fitted differences of the actuators; ``None`` if they were not fitted.
    extras
        Estimates of the extra parameters by name.
    influence_profile
        Fitted profile of the influence functions; ``None`` if it was not fitted.
    repeatability_covariance
        Covariance of the registration between runs of one set-up ``(5, 5)``: the part of ``covariance`` that
        does not drop out of their differences. ``None`` if it was not estimated.
    goodness_of_fit
        Residual relative to the noise; ``None`` if the noise was not known independently of the fit.
    """

    registration: Registration
    covariance: NDArray[np.float64]
    gain: Estimate
    width: Estimate
    converged: bool
    iterations: tuple[SprintIteration, ...]
    chi2: float
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    actuator_corrections: ActuatorCorrections | None = None
    extras: Mapping[str, Estimate] = field(default_factory=dict)
    influence_profile: InfluenceProfile | None = None
    repeatability_covariance: NDArray[np.float64] | None = None
    goodness_of_fit: GoodnessOfFit | None = None

    @property
    def model_fits(self) -> bool | None:
        """Whether the model fits to within noise and priors; ``None`` if that was not judged."""
        return None if self.goodness_of_fit is None else self.goodness_of_fit.fits

    @property
    def outcome(self) -> str:
        """Converged, converged without a fitting model, or not converged, in words."""
        return describe_outcome(self.converged, self.model_fits)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard errors ``(5,)`` in the order of ``PARAMETERS``."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def repeatability_sigma(self) -> NDArray[np.float64] | None:
        """Standard errors between runs of one set-up ``(5,)``; ``None`` if they were not estimated."""
        covariance = self.repeatability_covariance
        return None if covariance is None else np.sqrt(np.diag(covariance))

    def parameters(self) -> dict[str, Estimate]:
        """Every parameter with its standard error and unit."""
        values = self.registration.to_array()
        return {
            name: Estimate(float(v), float(s), UNITS[name])
            for name, v, s in zip(PARAMETERS, values, self.sigma, strict=True)
        }

    def __repr__(self) -> str:
        texts = ", ".join(f"{name} {text}" for name, text in self._formatted_values().items())
        return f"<{type(self).__name__} {texts}; {self.outcome} in {len(self.iterations)} iterations>"

    def _formatted_values(self) -> dict[str, str]:
        """Parameters and gain with errors and units, as texts."""
        texts = {
            name: f"{one.value:.3f} ± {one.sigma:.3f} {one.unit}"
            for name, one in {**self.parameters(), **self.extras}.items()
        }
        return {**texts, "gain": f"{self.gain.value:.4f} ± {self.gain.sigma:.4f}"}

    def _repr_html_(self) -> str:
        """Table of the parameters and plot of the step norms, for notebooks."""
        rows = {
            **self._formatted_values(),
            "outcome": f"{self.outcome}, {len(self.iterations)} iterations",
            **{f"warning {number}": text for number, text in enumerate(self.warnings, 1)},
        }
        return table_html(
            rows, "Registration", line_html([np.log10(max(one.step_norm, 1e-12)) for one in self.iterations])
        )


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A measured or pseudo-synthetic interaction matrix and its provenance.

    ``partial`` is true if the operator stopped the run early. ``mean_frame`` is the mean of the camera frames
    on which the geometry was found. ``measured`` is the DO-CRIME matrix to which the registration of an
    ESCAPE matrix was fitted.
    """

    matrix: InteractionMatrix
    grid: SensorGeometry
    frames: int
    lost_frames: int
    sky_seconds: float
    response: TemporalResponse | None = None
    registration: RegistrationEstimate | None = None
    measured: InteractionMatrix | None = None
    partial: bool = False
    mean_frame: NDArray[np.float32] | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        state = ", PARTIAL" if self.partial else ""
        parts = [
            f"{type(self).__name__} of {self.frames} frames, {self._frames_summary()}{state}",
            f"matrix: {self.matrix!r}",
        ]
        if self.registration is not None:
            parts.append(f"registration: {self.registration!r}")
        return f"<{chr(10).join(parts)}>".replace("\n", "\n  ")

    def _frames_summary(self) -> str:
        return f"{self.lost_frames} lost, {self.sky_seconds:.1f} s"

    def _repr_html_(self) -> str:
        """Tables of the matrix and of its registration, for notebooks."""
        parts = [self.matrix._repr_html_()]
        if self.registration is not None:
            parts.append(self.registration._repr_html_())
        rows = {
            "frames": f"{self.frames}, {self._frames_summary()}",
            **({"PARTIAL": "stopped by the operator"} if self.partial else {}),
            **{f"note {number}": text for number, text in enumerate(self.notes, 1)},
        }
        return "".join([*parts, table_html(rows)])


@dataclass(frozen=True, slots=True, eq=False)
class StrehlEstimate:
    """Strehl ratio three ways (paper, lab results): peak, optical transfer function, encircled energy."""

    peak: Estimate
    otf: Estimate
    encircled: Estimate


@dataclass(frozen=True, slots=True, eq=False)
class LoopResult:
    """A closed-loop run with one matrix.

    ``psf`` and ``model_psf`` are dark-subtracted images of the science camera with the same
    integration; ``latency_us`` holds wall-clock p50, p99 and max of the frame-to-command path.
    ``residual_nm`` is a decimated record of the residual wavefront rms seen by the sensor.
    ``gain_sigma`` is the standard error of a gain that was found by a search, else ``None``.
    """

    method: str
    gain: float
    leak: float
    dropped_modes: int
    frames: int
    lost_frames: int
    rate_hz: float
    stable: bool
    residual_rms_nm: float
    strehl: StrehlEstimate | None
    latency_us: dict[str, float]
    psf: NDArray[np.float32] | None = None
    model_psf: NDArray[np.float32] | None = None
    residual_nm: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    last_command: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    last_frame: NDArray[np.uint16] | None = None
    partial: bool = False
    notes: tuple[str, ...] = ()
    gain_sigma: float | None = None

    def __repr__(self) -> str:
        error = f" ± {self.gain_sigma:.1g}" if self.gain_sigma is not None else ""
        words = [
            f"{self.method} at gain {self.gain:.3g}{error}",
            f"{self.frames} frames at {self.rate_hz:.4g} Hz, {self.lost_frames} lost",
            "stable" if self.stable else "UNSTABLE",
            f"residual {self.residual_rms_nm:.3g} nm rms",
        ]
        if self.strehl is not None:
            words.append(f"Strehl ratio {self.strehl.peak.value:.3f} ± {self.strehl.peak.sigma:.3f}")
        return f"<{type(self).__name__} {', '.join(words)}{', PARTIAL' if self.partial else ''}>"
