"""A new pseudo-synthetic matrix from the live registration, and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate, RegistrationEstimate
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.api.tracking import Exchange
from escape_hw.calibration.sprint.synthetic_matrix import compute_pseudo_synthetic_matrix
from escape_hw.calibration.tracking.live_registration import LiveEstimate, scale_to_live_gains
from escape_hw.pipeline.control.reconstructor import reconstructor

#: A change counts when it is this many times what errors let one expect.
MIN_SIGNIFICANCE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class ActiveReconstructor:
    """What the loop runs with.

    Parameters
    ----------
    matrix, reconstructor
        ``(n_slopes, n_modes)`` and ``(n_modes, n_slopes)``.
    registration
        The registration behind the matrix.
    gain
        Mean gain of the modes beside the synthetic model's.
    """

    matrix: InteractionMatrix
    reconstructor: NDArray[np.float32]
    registration: RegistrationEstimate
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class ExchangeProposal:
    """A matrix to go on with, what it is better for, and whether it is worth it."""

    candidate: ActiveReconstructor
    evidence: Exchange
    exceeds_threshold: bool


def invert_matrix(matrix: InteractionMatrix, dropped: int) -> NDArray[np.float32]:
    """Reconstructor of a matrix, the weakest eigenmodes per stroke left out."""
    stroke = np.sqrt(np.mean(np.square(matrix.m2c), axis=0))
    return reconstructor(matrix.data, scale=stroke, dropped_modes=dropped)


def propose_exchange(
    synthetic: InteractionMatrix,
    model: SyntheticModel,
    live: LiveEstimate,
    in_use: ActiveReconstructor,
    dropped: int,
    seconds: float,
    worth: float,
) -> ExchangeProposal:
    """Hold a matrix of the live registration against the one in use.

    Parameters
    ----------
    made
        Pseudo-synthetic, at the live registration and the live common gain.
    model
        The model that it comes from.
    live
        The live registration.
    used
        What the loop runs with.
    dropped
        Eigenmodes left out.
    seconds
        Now.
    worth
        Relative change from which on an exchange is worthwhile.
    """
    new = scale_to_live_gains(synthetic, live)
    scale = float(np.linalg.norm(new.data))
    mismatch = float(np.linalg.norm(new.data - in_use.matrix.data)) / scale
    change = Estimate(live.registration.gain.value, float(live.gains_sigma.mean()))
    drift_only = replace(live.registration, covariance=live.change, gain=change)
    sigma = (
        float(np.linalg.norm(compute_pseudo_synthetic_matrix(model, drift_only, synthetic.m2c)[1])) / scale
    )
    loop = np.linalg.eigvals(in_use.reconstructor.astype(float) @ new.data.astype(float))
    # Dropped eigenmodes are left alone by every matrix.
    loop_gains = np.sort(np.abs(loop))[dropped:]
    now, then = live.registration, in_use.registration
    registration_change = now.registration.to_array() - then.registration.to_array()
    errors = np.sqrt(np.diag(live.change))
    gain = float(live.gains.mean())
    evidence = Exchange(
        seconds, False,
        {name: (float(m), float(s)) for name, m, s in zip(PARAMETERS, registration_change, errors, strict=True)},
        (gain / in_use.gain - 1, float(live.gains_sigma.mean()) / in_use.gain),
        mismatch, sigma, float(loop_gains[0]), float(loop_gains[-1]),
    )  # fmt: skip
    exceeds_threshold = mismatch > max(worth, MIN_SIGNIFICANCE * sigma)
    return ExchangeProposal(
        ActiveReconstructor(new, invert_matrix(new, dropped), now, gain), evidence, exceeds_threshold
    )


def accept_proposal(proposal: ExchangeProposal) -> Exchange:
    """The evidence of a proposal that the loop runs with."""
    return replace(proposal.evidence, accepted=True)
