"""How a mirror differs from its drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief

#: Width of the broad pedestal that influence functions may stand on, relative to their own.
PEDESTAL = 1.7


@dataclass(frozen=True, slots=True, eq=False)
class MirrorDepartures:
    """What SPRINT found of the mirror beside gain, registration and common width.

    Posterior means under priors of zero mean, so what the data hardly tell is nearly zero (best
    linear unbiased prediction; Robinson 1991).

    Parameters
    ----------
    gain, gain_sigma
        Relative gain of every actuator beyond the common one, and its standard error ``(n_act,)``.
    width
        Width of every influence function beyond the common one, relative ``(n_act,)``.
    pedestal
        Share of the broad pedestal in all influence functions.
    """

    gain: NDArray[np.float64]
    gain_sigma: NDArray[np.float64]
    width: NDArray[np.float64]
    pedestal: float
    __repr__ = brief
