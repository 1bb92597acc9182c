"""Whether a regression of slopes on pokes found more than chance, and how far chance reaches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import CalibrationError

#: Standard deviations by which the pokes must explain more of the slopes than chance would.
_CLEARLY = 5.0
#: What the colour of the noise adds to that: one filter for all slopes leaves some of each slope's own,
#: and where nothing responds the response comes out broad, so that it counts. Up to 1.3 on the twins.
_COLOUR = 1.5


def require_response(
    gram: NDArray[np.floating], matrix: NDArray[np.floating], covariance: NDArray[np.floating], lags: int
) -> None:
    """Refuse a matrix that chance alone explains.

    Without a response the pokes explain as much power as the noise has, with the scatter that as
    many degrees of freedom as modes times independent slopes leave; looking for the temporal
    response that explains most adds what the largest eigenvalue of a Wishart matrix exceeds the
    mean by (Marchenko & Pastur 1967).

    Parameters
    ----------
    gram
        Sum of pokes times pokes ``(n_modes, n_modes)``.
    matrix
        The least-squares matrix ``(n_slopes, n_modes)``.
    covariance
        Of the noise of one frame's slopes ``(n_slopes, n_slopes)``.
    lags
        Lags among which the response was looked for.

    Raises
    ------
    CalibrationError
        The sensor does not respond to the mirror, as far as these frames tell.
    """
    noise = float(np.trace(covariance))
    if not noise > 0:
        return
    n_modes = matrix.shape[1]
    ratio = float(np.vdot(matrix @ gram, matrix)) / (n_modes * noise)
    freedom = n_modes * noise**2 / float(np.square(covariance).sum())
    chance = _COLOUR * (1 + np.sqrt(lags / freedom)) ** 2 * (1 + _CLEARLY * np.sqrt(2 / freedom))
    if ratio < chance:
        raise CalibrationError(
            f"the wavefront sensor does not respond to the mirror: the pokes explain {ratio:.2f} times the "
            f"power of the noise, chance alone up to {chance:.2f}; check that there is light and that the "
            "mirror is in the beam and powered, or use larger pokes or more frames"
        )


def spread(noise: NDArray[np.floating], seen: NDArray[np.floating], at: NDArray[np.intp], lags: int) -> float:
    """Factor on the variance of a regression whose noise is not white.

    A poke that shows in several frames meets nearly the same turbulence in all of them:
    ``1 + 2 sum over k > 0 of rho_noise(k) rho_poke(k)``, with the autocorrelations of the noise and
    of the poke as the sensor sees it.

    Parameters
    ----------
    noise
        Slopes less what the pokes explain ``(n, n_slopes)``.
    seen
        Pokes through the temporal response ``(n, n_modes)``.
    at
        Time of each row in frames ``(n,)``, rising.
    lags
        Frames over which a poke shows.
    """
    clean = noise - noise.mean(axis=0)
    factor = 1.0
    for lag in range(1, lags):
        now = np.flatnonzero(np.isin(at - lag, at))
        past = np.searchsorted(at, at[now] - lag)
        factor += 2 * _correlation(clean, now, past) * _correlation(seen, now, past)
    return max(factor, 0.0)


def _correlation(values: NDArray[np.floating], now: NDArray[np.intp], past: NDArray[np.intp]) -> float:
    a, b = values[now], values[past]
    size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
    return float(np.vdot(a, b)) / size if size > 0 else 0.0
