"""Results as the procedures would return them, made up quickly for the tests of products and reports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from escape_hw.api.influence import InfluenceProfile
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.registration import Registration
from escape_hw.api.results import (
    ActuatorCorrections,
    CalibrationResult,
    Estimate,
    GoodnessOfFit,
    LoopResult,
    RegistrationEstimate,
    SprintIteration,
    StrehlEstimate,
    TemporalResponse,
)
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.io.provenance import Provenance

#: Of the products that the tests save.
ORIGIN = Provenance(basis="kl", seed=1)
INJECTED = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
SIGMA = np.array([0.4, 0.5, 0.012, 0.05, 0.06])


def layout() -> np.ndarray:
    """The 97 actuators of an 11 x 11 circle."""
    i, j = np.mgrid[-5:6, -5:6]
    return i**2 + j**2 <= 29


def grid(n: int = 24, seed: int = 0) -> SubApertureGrid:
    """A lenslet grid with a Gaussian beam over it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    flux = np.exp(-2 * (x**2 + y**2) / (0.75 * n) ** 2).astype(np.float32)
    valid = x**2 + y**2 < (n / 2) ** 2
    references = rng.normal(0, 0.3, (int(valid.sum()), 2)).astype(np.float32)
    return SubApertureGrid(
        15.55, (21.3, 19.8), valid, references, flux * valid, 3426.0, 1.1, 7.9, 0.8, 0.02, 1.1
    )


def basis(n_modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Plane-wave modes of rising frequency: wave vectors ``(n_modes, 2)`` and phases."""
    rng = np.random.default_rng(1)
    k = np.sqrt(np.arange(1, n_modes + 1))[:, None] * 0.28
    angle = rng.uniform(0, np.pi, n_modes)
    return k * np.stack([np.cos(angle), np.sin(angle)], axis=1), rng.uniform(0, np.pi, n_modes)


def matrix(
    method: str = "push-pull", noise: float = 0.01, n: int = 24, n_modes: int = 94, seed: int = 2
) -> InteractionMatrix:
    """A smooth matrix with noise of its own."""
    rng = np.random.default_rng(seed)
    valid = grid(n).valid
    y, x = np.argwhere(valid).T / n * 24 - 11.5
    waves, phases = basis(n_modes)
    slope = np.cos(np.outer(x, waves[:, 0]) + np.outer(y, waves[:, 1]) + phases)
    data = np.concatenate([slope * waves[:, 0], slope * waves[:, 1]])
    sigma = np.broadcast_to(noise * (1 + 6 / np.arange(1, n_modes + 1)), data.shape).astype(np.float32)
    i, j = np.argwhere(layout()).T - 5
    m2c = np.cos(np.outer(i, waves[:, 0]) + np.outer(j, waves[:, 1]) + phases) / 10
    return InteractionMatrix(
        data=(data + sigma * rng.standard_normal(data.shape)).astype(np.float32),
        sigma=sigma,
        m2c=m2c,
        valid=valid,
        system="razor-shwfs",
        method=method,
        simulated=True,
        metrics={"frames": 10_000, "poke": 0.02, "delay": 2.1, "lost": float("nan"), "model": "fast"},
    )


def registration(scale: float = 1.0, seed: int = 3) -> RegistrationEstimate:
    """A SPRINT run that comes close to the injected registration."""
    rng = np.random.default_rng(seed)
    goal = INJECTED.to_array() + scale * SIGMA * rng.standard_normal(5)
    steps = []
    for i in range(18):
        value = goal * (1 - 0.62**i) + 0.1 * SIGMA * rng.standard_normal(5) * (i > 0)
        steps.append(
            SprintIteration(
                Registration.from_array(value), 0.9 + 0.08 * (1 - 0.5**i), 0.62**i, 1 + 40 * 0.3**i
            )
        )
    return RegistrationEstimate(
        registration=Registration.from_array(goal),
        covariance=np.diag((scale * SIGMA) ** 2),
        gain=Estimate(0.982, 0.003),
        width=Estimate(1.031, 0.004),
        converged=True,
        iterations=tuple(steps),
        chi2=1.04,
        warnings=("tangential_scaling is consistent with zero",),
        actuator_corrections=ActuatorCorrections(
            rng.normal(0, 0.05, 97),
            np.full(97, 0.004),
            rng.normal(0, 0.02, 97),
            np.array([0.0, 0.0, 0.03]),
            rng.normal(0, 2.0, (2, 97)),
            np.full(97, 0.01),
            np.full((2, 97), 0.5),
            1e-6 * np.eye(4),
        ),
        influence_profile=influence_profile(),
    )


def influence_profile() -> InfluenceProfile:
    """Profile of a rounded exponential beside a Gaussian nominal one."""
    radius = np.arange(0.0, 4.01, 0.1)
    fitted = np.exp(-(np.hypot(radius, 0.27) - 0.27) / 0.9)
    sigma = 0.01 * radius * fitted
    return InfluenceProfile(radius, np.exp(-0.92 * radius**2), fitted, sigma, 1.1 * fitted, 2 * sigma)


def goodness_of_fit(n_valid: int, fits: bool = True) -> GoodnessOfFit:
    """Residuals of noise, or of a model that does not fit at a few sub-apertures and an actuator."""
    rng = np.random.default_rng(6)
    by_sub_aperture, by_actuator = (1 + 0.05 * rng.standard_normal(size) for size in (n_valid, 97))
    if not fits:
        by_sub_aperture[:3] *= 9.0
        by_actuator[23] *= 5.0
    return GoodnessOfFit(fits, 0.006 if fits else 0.144, by_sub_aperture, by_actuator)


def calibration(
    method: str = "escape", *, partial: bool = False, n: int = 24, n_modes: int = 94, fits: bool = True
) -> CalibrationResult:
    """What a calibration procedure returns."""
    escape = method == "escape"
    noise = {"push-pull": 0.01, "escape": 0.0}.get(method, 0.12)
    lenslets = grid(n)
    found = replace(registration(), goodness_of_fit=goodness_of_fit(lenslets.n_valid, fits))
    if not fits:
        found = replace(found, notes=("the model does not fit: 14% of the matrix remain",), chi2=22.4)
    return CalibrationResult(
        matrix=matrix(method, noise, n, n_modes),
        grid=lenslets,
        frames=10_000,
        lost_frames=7,
        sky_seconds=20.0,
        response=TemporalResponse(np.array([0.0, 0.1, 0.7, 0.2]), np.full(4, 0.01)),
        registration=found if escape else None,
        measured=matrix("docrime-whitened", 0.12, n, n_modes) if escape else None,
        partial=partial,
        mean_frame=wfs_frame(lenslets).astype(np.float32),
        notes=("7 frames lost: 0.07 %",),
    )


def wfs_frame(lenslets: SubApertureGrid, size: int = 400) -> np.ndarray:
    """Spots of a Shack-Hartmann sensor, 10 bit."""
    image = np.zeros((size, size))
    flux = lenslets.flux[lenslets.valid]
    y, x = np.mgrid[-5:6, -5:6]
    for (cx, cy), weight in zip(lenslets.centres_px() + lenslets.references_px, flux, strict=True):
        j, i = round(cx), round(cy)
        spot = np.exp(-((x + j - cx) ** 2 + (y + i - cy) ** 2) / 3.0)
        rows, columns = slice(max(i - 5, 0), min(i + 6, size)), slice(max(j - 5, 0), min(j + 6, size))
        image[rows, columns] += 700 * weight * spot[: rows.stop - rows.start, : columns.stop - columns.start]
    return np.clip(image + 12, 0, 1023).astype(np.uint16)


def psf(strehl: float, size: int = 128, seed: int = 4) -> np.ndarray:
    """An Airy-like core with a halo that holds the rest of the light."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] - size / 2
    radius = np.hypot(x, y) / 2.46 + 1e-6
    u = np.pi * radius
    airy = (2 * np.sin(u - np.pi / 4) * np.sqrt(2 / np.pi / np.maximum(u, 1.2)) / np.maximum(u, 1.2)) ** 2
    core = np.where(radius < 0.6, np.cos(np.pi * radius / 2.4) ** 2, np.minimum(airy, 0.5))
    halo = 0.25 * np.exp(-((radius / 6) ** 2))
    image = 3000 * (strehl * core + (1 - strehl) * 0.05 * halo * rng.gamma(4, 0.25, core.shape))
    return (image + rng.normal(0, 0.4, core.shape)).astype(np.float32)


def loop(
    method: str = "escape", *, strehl: float = 0.62, stable: bool = True, partial: bool = False
) -> LoopResult:
    """What a closed-loop run returns."""
    rng = np.random.default_rng(5)
    n_act = int(layout().sum())
    return LoopResult(
        method=method,
        gain=0.4,
        leak=0.026,
        dropped_modes=14,
        frames=5000,
        lost_frames=2,
        rate_hz=500.0,
        stable=stable,
        residual_rms_nm=71.5,
        strehl=StrehlEstimate(
            Estimate(strehl, 0.012), Estimate(strehl + 0.02, 0.015), Estimate(strehl + 0.09, 0.008)
        ),
        latency_us={"p50": 310.0, "p99": 480.0, "max": 900.0},
        psf=psf(strehl),
        model_psf=psf(1.0),
        residual_nm=(70 + 300 * np.exp(-np.arange(500) / 8) + rng.normal(0, 6, 500)).astype(np.float32),
        last_command=rng.normal(0, 0.12, n_act),
        last_frame=wfs_frame(grid()),
        partial=partial,
        notes=(),
    )


def sky_time() -> dict[str, object]:
    """Error against frames, as the benchmark writes it."""
    frames = [200, 500, 1000, 2000, 5000, 10000]
    names = Registration().to_dict()
    bound = {
        name: [float(s * np.sqrt(300 / f)) for f in frames] for name, s in zip(names, SIGMA, strict=True)
    }
    return {
        "realisations": 20,
        "fewest_frames": {"whitened": 500, "unwhitened": None},
        "frames": frames,
        "estimators": {
            "whitened": {name: [1.3 * v for v in values] for name, values in bound.items()},
            "unwhitened": {name: [25 * v for v in values] for name, values in bound.items()},
        },
        "bound": bound,
    }


def optical_gains(level: float, n: int = 20) -> OpticalGains:
    """Gains around a level; one mode was not measured."""
    rng = np.random.default_rng(0)
    sigma = np.full(n, 0.02 * level)
    sigma[4] = np.inf
    value = level + sigma[0] * rng.standard_normal(n)
    small = np.full(n, 0.01)
    return OpticalGains(value, sigma, np.full(n, level), small, value, small, 0.004)


def gains_result() -> GainsResult:
    """What a bootstrap of the optical gains returns."""
    strehl = StrehlEstimate(*(Estimate(0.3, 0.01) for _ in range(3)))
    first = GainRound(optical_gains(0.7), 0.004, 800, 0.1, 0.03, 70.0, 0.25, True)
    last = GainRound(optical_gains(0.72), 0.0004, 9000, 0.02, 0.02, 60.0, 0.01, True, strehl)
    steps = (ClosureStep(1e-6, 0.4, 0.02, 300.0, True), ClosureStep(0.2, np.nan, np.nan, np.inf, False))
    return GainsResult(
        "escape",
        (first, last),
        steps,
        True,
        0.425,
        12000,
        7,
        {"DO-CRIME": optical_gains(1.8)},
        False,
        ("a note",),
    )
