"""Regression of slopes on commands that follow the turbulence, with pokes as instruments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.response import Filtered

#: Lags over which what is left of the noise's correlation is followed.
_FOLLOWED = 8


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """The temporal response, what all of it adds up to in terms of the model, and their errors.

    ``common_sigma`` is the relative standard error that the response puts on every gain.
    """

    temporal: TemporalResponse
    total: float
    total_sigma: float
    common_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Filtered rows: projected slopes ``(n, n_seen)``, commands and pokes ``(lags, n, n_modes)``."""

    slopes: NDArray[np.float32]
    commands: NDArray[np.float32]
    pokes: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Response and matrix.

    Parameters
    ----------
    matrix
        ``(n_seen, n_modes)``.
    noise
        Covariance of one frame's noise ``(n_seen, n_seen)``.
    spread
        What to multiply a slope's noise variance by for the variance of an element ``(n_modes,)``.
    """

    response: Response
    matrix: NDArray[np.float64]
    noise: NDArray[np.float64]
    spread: NDArray[np.float64]


class InstrumentSums:
    """Sums over frames of filtered slopes q, commands x and pokes z, by lag.

    Parameters
    ----------
    n_seen, n_modes, lags
        Sizes.
    """

    def __init__(self, n_seen: int, n_modes: int, lags: int) -> None:
        self._n_seen, self._n_modes, self._lags = n_seen, n_modes, lags
        # One column of ones, for the means.
        width = n_seen + 2 * lags * n_modes + 1
        self._sums = np.zeros((width, width))
        self.count = 0

    def add(self, rows: Filtered) -> Block | None:
        """Add filtered rows whose second half of columns are commands and pokes; ``None``: none usable."""
        if not rows.now.size:
            return None
        sent = np.stack([rows.before(lag)[:, self._n_seen :] for lag in range(self._lags)])
        block = Block(rows.slopes, sent[:, :, : self._n_modes], sent[:, :, self._n_modes :])
        parts = [block.slopes, *block.commands, *block.pokes, np.ones((rows.now.size, 1), np.float32)]
        whole = np.concatenate(parts, axis=1)
        self._sums += whole.T @ whole
        self.count += rows.now.size
        return block

    def solve(self, model: NDArray[np.float64]) -> Solution:
        """Response and matrix.

        Parameters
        ----------
        model
            What the first ``n_modes`` projected slopes answer to the modes ``(n_modes, n_modes)``, up to a
            factor; the temporal response, common to all modes, is found through it.

        Raises
        ------
        numpy.linalg.LinAlgError
            The pokes do not span the modes.
        """
        part, n = self._parts(), self._n_modes
        # The slopes' noise weighs them in the response: first as if all of them were noise.
        rough = self._matrix(part, self._response(part, model, part["qq"][:n, :n] / self.count))
        return self._matrix(part, self._response(part, model, rough.noise[:n, :n]))

    def _response(
        self, part: dict[str, NDArray[np.float64]], model: NDArray[np.float64], noise: NDArray[np.float64]
    ) -> Response:
        n = self._n_modes
        noise = noise + np.eye(n) * (1e-6 * np.trace(noise) / n + 1e-30)
        pattern = np.linalg.solve(noise, model)
        square = model.T @ pattern
        right = np.einsum("im,lmi->l", pattern, part["zq"][:, :, :n])
        normal = np.einsum("mn,lmkn->lk", square, part["zx"])
        inverse = np.linalg.inv(normal)
        free = inverse @ right
        # Of sum pattern z e^T with noise e: the pattern's noise weights make it the square again.
        covariance = inverse @ np.einsum("mn,lmkn->lk", square, part["zz"]) @ inverse.T
        total = float(free.sum())
        shares = free / total
        scaled = (np.eye(shares.size) - shares[:, None]) / total
        spread = scaled @ covariance @ scaled.T
        # d ln(gain) = -(w^T A dw) / (w^T A w) for a dw that keeps the sum.
        lever = normal.T @ shares
        common = float(np.sqrt(max(lever @ spread @ lever, 0.0))) / abs(float(lever @ shares))
        temporal = TemporalResponse(shares, np.sqrt(np.diag(spread)))
        return Response(temporal, total, float(np.sqrt(covariance.sum())), common)

    def _matrix(self, part: dict[str, NDArray[np.float64]], response: Response) -> Solution:
        """``M = (sum q z^T)(sum x z^T)^-1``, commands and pokes seen through the response."""
        w = response.temporal.weights
        zx, xx, zz = (np.einsum("l,k,lmkn->mn", w, w, part[name]) for name in ("zx", "xx", "zz"))
        zq, xq = (np.einsum("l,lmi->mi", w, part[name]) for name in ("zq", "xq"))
        # q = M x, so sum z q^T = (sum z x^T) M^T.
        inverse = np.linalg.inv(zx)
        found = (inverse @ zq).T
        cross = found @ xq
        left = part["qq"] - cross - cross.T + found @ xx @ found.T
        freedom = max(self.count - self._n_modes - self._lags, 1)
        spread = np.einsum("mk,kn,mn->m", inverse, zz, inverse)
        return Solution(response, found, left / freedom, spread)

    def spread(self, block: Block, model: NDArray[np.float64]) -> NDArray[np.float64]:
        """Factor on each slope's noise variance for what is left of its correlation in time ``(n_seen,)``.

        ``1 + 2 sum over k > 0 of rho_noise(k) rho_poke(k)``, as
        :func:`~escape_hw.calibration.significance.spread`, one for each slope.
        """
        solution = self.solve(model)
        weights, found = solution.response.temporal.weights, solution.matrix.astype(np.float32)
        seen, pokes = (np.tensordot(weights.astype(np.float32), p, 1) for p in (block.commands, block.pokes))
        noise = block.slopes - seen @ found.T
        noise -= noise.mean(axis=0)
        power, poked = np.einsum("ti,ti->i", noise, noise), float(np.vdot(pokes, pokes))
        factor = np.ones(self._n_seen)
        for lag in range(1, min(_FOLLOWED, len(noise) // 4) + 1):
            own = np.einsum("ti,ti->i", noise[lag:], noise[:-lag]) / np.maximum(power, 1e-30)
            factor += 2 * own * float(np.vdot(pokes[lag:], pokes[:-lag])) / max(poked, 1e-30)
        return np.maximum(factor, 0.05)

    def _parts(self) -> dict[str, NDArray[np.float64]]:
        """The sums about the means, by kind and lag."""
        mean = self._sums[:-1, -1]
        whole = self._sums[:-1, :-1] - np.outer(mean, mean) / max(self.count, 1)
        q, n = self._n_seen, self._lags * self._n_modes
        shape = (self._lags, self._n_modes)
        x, z = slice(q, q + n), slice(q + n, q + 2 * n)
        return {
            "qq": whole[:q, :q],
            "zq": whole[z, :q].reshape(*shape, q),
            "xq": whole[x, :q].reshape(*shape, q),
            "zx": whole[z, x].reshape(*shape, *shape),
            "xx": whole[x, x].reshape(*shape, *shape),
            "zz": whole[z, z].reshape(*shape, *shape),
        }
