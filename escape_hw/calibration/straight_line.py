"""Estimates with a fading memory lag behind what drifts; a straight line through them does not.

What an exponentially forgotten sum yields is the mean of the truth over its memory, of age ``A``. The
same mean taken once more over those estimates is older, of age ``B``. Along a straight line the truth
now is ``S + A (S - T) / (B - A)``, with ``S`` the first mean and ``T`` the second (Brown 1963, double
exponential smoothing, with the ages as they are while the memory still fills).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Updates before which nothing is a surprise, and what each adds to what is known of surprises.
_SETTLED, _LEARNING = 4, 0.15
#: A mean miss counts from this many times its noise's variance on.
_MORE = 3.0
#: A single surprise, squared, teaches no more than this: a jump is not what is usual.
_MOST = 36.0


@dataclass(frozen=True, slots=True, eq=False)
class Present:
    """The truth now, as far as it goes along a straight line.

    Parameters
    ----------
    value, rate
        Level ``(n,)`` and change per second ``(n,)``.
    covariance, moving
        Of the level ``(n, n)``: the whole, and the part of it that differs from update to update.
    surprise
        By how many standard errors the last update's own data missed what was expected ``(n,)``, as
        errors have been of late.
    """

    value: NDArray[np.float64]
    rate: NDArray[np.float64]
    covariance: NDArray[np.float64]
    moving: NDArray[np.float64]
    surprise: NDArray[np.float64]


class StraightLine:
    """Follows several parameters along a straight line.

    Parameters
    ----------
    forgetting
        What each update leaves of the weights before it, in (0, 1).
    step_s
        Seconds between updates.
    fastest
        How fast the parameters may drift, one standard deviation, per second ``(n,)``. It only matters
        while the memory fills and the data cannot yet tell.
    """

    def __init__(self, forgetting: float, step_s: float, fastest: NDArray[np.float64]) -> None:
        self._keep, self._step, self._fastest = forgetting, step_s, np.asarray(fastest, float)
        # What surprises usually are, squared: known for good, whatever is forgotten.
        self._strain = np.ones(len(self._fastest))
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        n = len(self._fastest)
        self._weight = 0.0
        self._mean, self._second = np.zeros(n), np.zeros(n)
        # Shares of each update's own noise in both means, the oldest first.
        self._first_shares, self._second_shares = np.zeros(0), np.zeros(0)
        self._expected: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._miss, self._bend = np.zeros(n), np.zeros(n)

    def update(
        self, mean: NDArray[np.float64], noise: NDArray[np.float64], static: NDArray[np.float64]
    ) -> Present:
        """Take the estimate that the forgotten sums yield now.

        Parameters
        ----------
        mean
            The estimate ``(n,)``.
        noise
            Covariance of what is new with every frame in it ``(n, n)``.
        static
            Covariance of what is not, such as what the model misses ``(n, n)``.
        """
        self._weight = self._keep * self._weight + 1
        share = 1 / self._weight
        own = self._mean + (mean - self._mean) / share
        self._first_shares = np.append(self._first_shares * (1 - share), share)
        self._second_shares = np.append(self._second_shares * (1 - share), 0) + share * self._first_shares
        self._mean, self._second = mean, self._second + share * (mean - self._second)
        first, second = self._first_shares, self._second_shares
        ages = self._step * (np.arange(len(first))[::-1] + 0.5)
        here, older = float(first @ ages), float(second @ ages)
        one = noise / float(first @ first)
        value, rate, variance = mean, np.zeros_like(mean), np.square(here * self._fastest)
        shares = np.broadcast_to(first, (len(mean), len(first)))
        if older > here:
            free = (mean - self._second) / (older - here)
            doubt = np.diag(one) * float(np.square(first - second).sum()) / (older - here) ** 2
            believed = np.square(self._fastest) / (np.square(self._fastest) + doubt)
            rate = believed * free
            value = mean + here * rate
            shares = first + (believed * here / (older - here))[:, None] * (first - second)
            variance = np.square(here * self._fastest * (1 - believed))
        moving = one * (shares @ shares.T) + np.diag(variance)
        missed, bend = self._surprise(own, one)
        surprise = missed / np.sqrt(np.maximum(self._strain, 1.0))
        self._strain += _LEARNING * (np.minimum(np.square(missed), _MOST) - self._strain)
        stretch = np.sqrt(np.maximum(self._strain, 1.0))
        moving = moving * np.outer(stretch, stretch) + np.diag(bend)
        present = Present(value, rate, static + moving, moving, surprise)
        # The next update's own data are, in the mean, half a step old.
        self._expected = value + 0.5 * self._step * rate, np.diag(moving)
        self._trim()
        return present

    def _surprise(
        self, own: NDArray[np.float64], one: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance of one update's own data from the line so far, in standard errors, and the line's bend.

        What bends more than a line within the memory misses what was expected again and again to the same
        side: the square of the mean miss, where it is more than noise makes of it, is variance that a line
        leaves out, and is forgotten slowly, for a swing turns round.
        """
        if self._expected is None or len(self._first_shares) < _SETTLED:
            return np.zeros_like(own), np.zeros_like(own)
        value, variance = self._expected
        noise = np.diag(one) + variance
        missed = own - value
        self._miss += _LEARNING * (missed - self._miss)
        more = np.square(self._miss) - _MORE * noise * _LEARNING / (2 - _LEARNING)
        self._bend = np.maximum(more, self._bend * (1 - _LEARNING / 2))
        return missed / np.sqrt(noise + np.square(self._step * self._fastest)), self._bend

    def _trim(self) -> None:
        """Drop the oldest shares once they weigh nothing."""
        if len(self._first_shares) > 40 / (1 - self._keep):
            half = len(self._first_shares) // 2
            self._first_shares = self._first_shares[half:]
            self._second_shares = self._second_shares[half:]
