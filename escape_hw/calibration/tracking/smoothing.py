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
_MIN_UPDATES, _LEARNING_RATE = 4, 0.15
#: A mean miss counts from this many times its noise's variance on.
_BIAS_THRESHOLD = 3.0
#: A single surprise, squared, teaches no more than this: a jump is not what is usual.
_MAX_INNOVATION = 36.0


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedState:
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
    random_covariance: NDArray[np.float64]
    surprise: NDArray[np.float64]


class DoubleExponentialSmoother:
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

    def __init__(self, forgetting: float, step_s: float, max_rate: NDArray[np.float64]) -> None:
        self._forgetting, self._step_s, self._max_rate = forgetting, step_s, np.asarray(max_rate, float)
        # What surprises usually are, squared: known for good, whatever is forgotten.
        self._innovation_variance = np.ones(len(self._max_rate))
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        n = len(self._max_rate)
        self._weight = 0.0
        self._mean, self._second = np.zeros(n), np.zeros(n)
        # Shares of each update's own noise in both means, the oldest first.
        self._first_shares, self._second_shares = np.zeros(0), np.zeros(0)
        self._expected: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._mean_innovation, self._curvature_variance = np.zeros(n), np.zeros(n)

    def update(
        self, mean: NDArray[np.float64], noise: NDArray[np.float64], static: NDArray[np.float64]
    ) -> SmoothedState:
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
        self._weight = self._forgetting * self._weight + 1
        share = 1 / self._weight
        new_estimate = self._mean + (mean - self._mean) / share
        self._first_shares = np.append(self._first_shares * (1 - share), share)
        self._second_shares = np.append(self._second_shares * (1 - share), 0) + share * self._first_shares
        self._mean, self._second = mean, self._second + share * (mean - self._second)
        first, second = self._first_shares, self._second_shares
        ages = self._step_s * (np.arange(len(first))[::-1] + 0.5)
        first_age, second_age = float(first @ ages), float(second @ ages)
        single_update_covariance = noise / float(first @ first)
        value, rate, variance = mean, np.zeros_like(mean), np.square(first_age * self._max_rate)
        shares = np.broadcast_to(first, (len(mean), len(first)))
        if second_age > first_age:
            unshrunk_rate = (mean - self._second) / (second_age - first_age)
            rate_variance = (
                np.diag(single_update_covariance)
                * float(np.square(first - second).sum())
                / (second_age - first_age) ** 2
            )
            shrinkage = np.square(self._max_rate) / (np.square(self._max_rate) + rate_variance)
            rate = shrinkage * unshrunk_rate
            value = mean + first_age * rate
            shares = first + (shrinkage * first_age / (second_age - first_age))[:, None] * (first - second)
            variance = np.square(first_age * self._max_rate * (1 - shrinkage))
        random_covariance = single_update_covariance * (shares @ shares.T) + np.diag(variance)
        raw_innovation, curvature_variance = self._compute_innovation(new_estimate, single_update_covariance)
        surprise = raw_innovation / np.sqrt(np.maximum(self._innovation_variance, 1.0))
        self._innovation_variance += _LEARNING_RATE * (
            np.minimum(np.square(raw_innovation), _MAX_INNOVATION) - self._innovation_variance
        )
        error_scale = np.sqrt(np.maximum(self._innovation_variance, 1.0))
        random_covariance = random_covariance * np.outer(error_scale, error_scale) + np.diag(
            curvature_variance
        )
        present = SmoothedState(value, rate, static + random_covariance, random_covariance, surprise)
        # The next update's own data are, in the mean, half a step old.
        self._expected = value + 0.5 * self._step_s * rate, np.diag(random_covariance)
        self._trim()
        return present

    def _compute_innovation(
        self, new_estimate: NDArray[np.float64], single_update_covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance of one update's own data from the line so far, in standard errors, and the line's bend.

        What bends more than a line within the memory misses what was expected again and again to the same
        side: the square of the mean miss, where it is more than noise makes of it, is variance that a line
        leaves out, and is forgotten slowly, for a swing turns round.
        """
        if self._expected is None or len(self._first_shares) < _MIN_UPDATES:
            return np.zeros_like(new_estimate), np.zeros_like(new_estimate)
        value, variance = self._expected
        noise = np.diag(single_update_covariance) + variance
        raw_innovation = new_estimate - value
        self._mean_innovation += _LEARNING_RATE * (raw_innovation - self._mean_innovation)
        excess = np.square(self._mean_innovation) - _BIAS_THRESHOLD * noise * _LEARNING_RATE / (
            2 - _LEARNING_RATE
        )
        self._curvature_variance = np.maximum(excess, self._curvature_variance * (1 - _LEARNING_RATE / 2))
        return raw_innovation / np.sqrt(
            noise + np.square(self._step_s * self._max_rate)
        ), self._curvature_variance

    def _trim(self) -> None:
        """Drop the oldest shares once they weigh nothing."""
        if len(self._first_shares) > 40 / (1 - self._forgetting):
            half = len(self._first_shares) // 2
            self._first_shares = self._first_shares[half:]
            self._second_shares = self._second_shares[half:]
