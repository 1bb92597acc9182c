"""A new pseudo-synthetic matrix from the live registration, and the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Measured, RegistrationEstimate
from escape_hw.api.tracking import Exchange
from escape_hw.calibration.live_registration import LiveEstimate, scaled_to_gains
from escape_hw.calibration.pseudo_synthetic import pseudo_synthetic
from escape_hw.pipeline.reconstructor import reconstructor

#: A change counts when it is this many times what errors let one expect.
SIGNIFICANT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class InUse:
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
class Proposal:
    """A matrix to go on with, what it is better for, and whether it is worth it."""

    to_use: InUse
    evidence: Exchange
    worthwhile: bool


def inverted(matrix: InteractionMatrix, dropped: int) -> NDArray[np.float32]:
    """Reconstructor of a matrix, the weakest eigenmodes per stroke left out."""
    stroke = np.sqrt(np.mean(np.square(matrix.m2c), axis=0))
    return reconstructor(matrix.data, scale=stroke, dropped_modes=dropped)


def propose(
    made: InteractionMatrix,
    model: SyntheticModel,
    live: LiveEstimate,
    used: InUse,
    dropped: int,
    seconds: float,
    worth: float,
) -> Proposal:
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
    new = scaled_to_gains(made, live)
    scale = float(np.linalg.norm(new.data))
    mismatch = float(np.linalg.norm(new.data - used.matrix.data)) / scale
    change = Measured(live.registration.gain.value, float(live.gains_sigma.mean()))
    only = replace(live.registration, covariance=live.change, gain=change)
    sigma = float(np.linalg.norm(pseudo_synthetic(model, only, made.m2c)[1])) / scale
    loop = np.linalg.eigvals(used.reconstructor.astype(float) @ new.data.astype(float))
    # Dropped eigenmodes are left alone by every matrix.
    kept = np.sort(np.abs(loop))[dropped:]
    now, then = live.registration, used.registration
    moved = now.registration.to_array() - then.registration.to_array()
    errors = np.sqrt(np.diag(live.change))
    gain = float(live.gains.mean())
    evidence = Exchange(
        seconds, False,
        {name: (float(m), float(s)) for name, m, s in zip(PARAMETERS, moved, errors, strict=True)},
        (gain / used.gain - 1, float(live.gains_sigma.mean()) / used.gain),
        mismatch, sigma, float(kept[0]), float(kept[-1]),
    )  # fmt: skip
    worthwhile = mismatch > max(worth, SIGNIFICANT * sigma)
    return Proposal(InUse(new, inverted(new, dropped), now, gain), evidence, worthwhile)


def taken(proposal: Proposal) -> Exchange:
    """The evidence of a proposal that the loop runs with."""
    return replace(proposal.evidence, accepted=True)
