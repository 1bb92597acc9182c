"""Regression of slopes on what a matrix makes of the commands at several lags, frame after frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse

#: Share of the largest singular value below which a direction counts as not seen: single precision ends here.
_SEEN = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class ResponseEstimate:
    """A temporal response with the covariance of its weights ``(lags, lags)``, whose errors sum to zero."""

    weights: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def response(self) -> TemporalResponse:
        """With standard errors alone."""
        return TemporalResponse(self.weights, np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    def combined(self, other: ResponseEstimate) -> ResponseEstimate:
        """The mean of two independent estimates, weighed by their covariances."""
        both = np.linalg.pinv(self.covariance + other.covariance, rcond=_SEEN, hermitian=True)
        share = self.covariance @ both
        covariance = self.covariance - share @ self.covariance
        return ResponseEstimate(
            self.weights + share @ (other.weights - self.weights), (covariance + covariance.T) / 2
        )


class LagSums:
    """Weights of the lags by instrumental variables, and their errors.

    With slopes ``y``, predictions ``x`` from the commands and ``z`` from the pokes, the instruments,
    the weights solve ``sum_t z_l(t) (y(t) - sum_k w_k x_k(t)) = 0`` (Söderström & Stoica 1983). Each
    frame's products ``z_l y`` and ``z_l x_k`` are summed, and so are the products of those with each
    other: that gives the scores' covariance for whatever weights come out in the end (White 1980), in
    which slopes may err together, but frames do not.

    Parameters
    ----------
    lags
        Number of lags.
    """

    def __init__(self, lags: int) -> None:
        self._lags, size = lags, lags * (lags + 1)
        self._products, self._squares = np.zeros(size), np.zeros((size, size))
        self._frames = np.zeros(1)

    def add(self, slopes: NDArray[np.float32], made: NDArray[np.float32], poked: NDArray[np.float32]) -> Self:
        """Add frames: slopes ``(n, n_slopes)``, predictions and instruments ``(n, lags, n_slopes)``, centred.

        All predictions should have one scale: what they miss of the commands' motion is noise.
        """
        beside = np.concatenate([slopes[:, None], made], axis=1).transpose(0, 2, 1)
        products = np.matmul(poked, beside).reshape(len(slopes), -1).astype(np.float64)
        self._products += products.sum(axis=0)
        self._squares += products.T @ products
        self._frames += len(slopes)
        return self

    def merge(self, other: LagSums) -> Self:
        """Add the frames of another."""
        for name, array in self.arrays().items():
            array += other.arrays()[name]
        return self

    def widen(self, factor: float) -> Self:
        """Multiply the scores' covariance, for frames that do not err independently."""
        self._squares *= factor
        return self

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All sums by name, themselves and no copies: written into, they are restored."""
        return {"products": self._products, "squares": self._squares, "frames": self._frames}

    @property
    def count(self) -> int:
        """Frames added."""
        return int(self._frames[0])

    def weights(self) -> NDArray[np.float64]:
        """Weights of the lags as regressed, of any scale ``(lags,)``."""
        right, bread = self._solved()
        return np.asarray(bread @ right)

    def response(self) -> ResponseEstimate:
        """The weights scaled to sum 1."""
        right, bread = self._solved()
        weights = bread @ right
        total = weights.sum()
        score = np.kron(np.eye(self._lags), np.concatenate([[1.0], -weights]))
        # Scaled to sum 1, a weight errs with all others: d(w / sum) = (1 - w 1^T) dw / sum.
        scaled = (np.eye(self._lags) - (weights / total)[:, None]) @ bread @ score / total
        return ResponseEstimate(weights / total, scaled @ self._squares @ scaled.T)

    def _solved(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Right-hand side and inverse of the normal equations."""
        table = self._products.reshape(self._lags, self._lags + 1)
        return table[:, 0], np.asarray(np.linalg.pinv(table[:, 1:], rcond=_SEEN))
