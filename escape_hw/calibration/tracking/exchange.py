"""Exchange of the reconstructor: a new pseudo-synthetic matrix compared with the matrix in use."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate, RegistrationEstimate
from escape_hw.api.tracking import Exchange
from escape_hw.calibration.loop.control import invert_matrix
from escape_hw.calibration.tracking.live_registration import LiveEstimate, scale_to_live_gains

#: Change of the matrix, in standard errors, above which it is significant.
MIN_SIGNIFICANCE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class ActiveReconstructor:
    """The matrix and its reconstructor ``(n_modes, n_slopes)`` in use, and the registration of the matrix."""

    matrix: InteractionMatrix
    reconstructor: NDArray[np.float32]
    registration: RegistrationEstimate
    #: Mean gain of the modes relative to the synthetic model.
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class ExchangeProposal:
    """A new matrix, the evidence for it, and whether its change exceeds the threshold and the errors."""

    candidate: ActiveReconstructor
    evidence: Exchange
    exceeds_threshold: bool


def propose_exchange(
    synthetic: InteractionMatrix,
    live: LiveEstimate,
    in_use: ActiveReconstructor,
    dropped: int,
    seconds: float,
    exchange_threshold: float,
) -> ExchangeProposal:
    """Compare the matrix at the live registration with the one in use.

    ``synthetic``: pseudo-synthetic matrix at the live registration and the live common gain;
    ``exchange_threshold``: relative change of the matrix above which an exchange is proposed.
    """
    new = scale_to_live_gains(synthetic, live)
    scale = float(np.linalg.norm(new.data))
    mismatch = float(np.linalg.norm(new.data - in_use.matrix.data)) / scale
    live_gain = Estimate(live.registration.gain.value, float(live.gains_sigma.mean()))
    drift_only = replace(live.registration, covariance=live.change_covariance, gain=live_gain)
    errors = live.fitted.with_errors(drift_only)[1]
    sigma = float(np.linalg.norm(errors)) / scale
    loop = np.linalg.eigvals(in_use.reconstructor.astype(float) @ new.data.astype(float))
    # The loop gain of dropped eigenmodes is 0.
    loop_gains = np.sort(np.abs(loop))[dropped:]
    now, then = live.registration, in_use.registration
    moved = now.registration.to_array() - then.registration.to_array()
    errors = np.sqrt(np.diag(live.change_covariance))
    gain = float(live.gains.mean())
    evidence = Exchange(
        seconds, False,
        {name: (float(m), float(s)) for name, m, s in zip(PARAMETERS, moved, errors, strict=True)},
        (gain / in_use.gain - 1, float(live.gains_sigma.mean()) / in_use.gain),
        mismatch, sigma, float(loop_gains[0]), float(loop_gains[-1]),
    )  # fmt: skip
    exceeds_threshold = mismatch > max(exchange_threshold, MIN_SIGNIFICANCE * sigma)
    return ExchangeProposal(
        ActiveReconstructor(new, invert_matrix(new, dropped), now, gain), evidence, exceeds_threshold
    )
