"""Whether a command obeys every limit, in one compiled pass: most do, and a loop waits for the answer."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
def legal(shape, last, disabled, averaging, one, other, max_stroke, max_slew, max_mean, max_neighbour):  # type: ignore[no-untyped-def]  # pragma: no cover
    """True when a shape ``(n_act,)`` obeys; what is not a number does not.

    Parameters are those of :class:`~escape_hw.safety.guard.CommandGuard`, limits with head-room for rounding
    and infinite where a rule is off; ``averaging (n_act,)`` is empty where there is none for the mean.
    """
    for i in range(shape.size):
        if not (abs(shape[i]) <= max_stroke and abs(shape[i] - last[i]) <= max_slew):
            return False
    for i in disabled:
        if shape[i] != 0.0:
            return False
    mean = 0.0
    for i in range(averaging.size):
        mean += shape[i] * averaging[i]
    if not abs(mean) <= max_mean:
        return False
    for k in range(one.size):  # noqa: SIM110 - compiled, and faster than what it would become
        if not abs(shape[one[k]] - shape[other[k]]) <= max_neighbour:
            return False
    return True
