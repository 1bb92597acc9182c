"""Compiled check of a command against every limit, for the hot path of the loop."""

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True)
def obeys_limits(  # type: ignore[no-untyped-def]
    shape,
    last,
    disabled,
    mean_weights,
    first_of_pair,
    second_of_pair,
    max_stroke,
    max_slew,
    max_mean,
    max_neighbour,
    max_abs_sum,
):  # pragma: no cover
    """Whether a shape ``(n_act,)`` obeys every limit; NaN does not.

    Parameters as in :class:`~escape_hw.safety.guard.CommandGuard`. Limits include the tolerance for rounding
    and are infinite where a rule is off; ``mean_weights (n_act,)`` is empty if the mean rule is off.
    """
    for i in range(shape.size):
        if not (abs(shape[i]) <= max_stroke and abs(shape[i] - last[i]) <= max_slew):
            return False
    for i in disabled:
        if shape[i] != 0.0:
            return False
    mean = 0.0
    for i in range(mean_weights.size):
        mean += shape[i] * mean_weights[i]
    if not abs(mean) <= max_mean:
        return False
    if max_abs_sum < math.inf:
        total = 0.0
        for i in range(shape.size):
            total += abs(shape[i])
        if not total <= max_abs_sum:
            return False
    for k in range(first_of_pair.size):
        if not abs(shape[first_of_pair[k]] - shape[second_of_pair[k]]) <= max_neighbour:
            return False
    return True
