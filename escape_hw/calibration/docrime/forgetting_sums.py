"""Pokes as instruments: interaction matrices from telemetry in which a controller moves the mirror, too.

In closed loop the command answers to the turbulence, so least squares of slopes on commands is biased.
Pokes know nothing of turbulence, noise or controller. With ``y`` the whitened slopes, ``x`` the whitened
command and ``z`` the whitened pokes, both as seen through the temporal response,

    sum y z^T = D sum x z^T + E ,    columns of E with covariance  var(y - D x) sum z z^T ,

whatever the controller does (instrumental variables, Soderstrom & Stoica 1983). Turned onto the
eigenvectors of ``sum z z^T`` the columns err equally and independently, and SPRINT fits them as any
matrix. In open loop ``x = z`` and this is least squares.

One thing must be seen to. The controller's part of ``sum x z^T`` averages out, but as long as it has not,
it goes with ``E``, for both hold the same turbulence; a fit to ``D sum x z^T`` would lean on that and be
drawn towards the biased answer (the bias of weak instruments, Bound et al. 1995). So what is fitted is
``D c sum z z^T``, whose factor only depends on the pokes, and the rest, ``D (sum x z^T - c sum z z^T)``,
is subtracted beforehand with the best ``D`` known: the fixed point is the solution of the instrumental
equations themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.docrime.open_loop import MAX_CORRELATED_SLOPES

#: Directions that the pokes took less than this share of the strongest tell nothing.
MIN_POWER_RATIO = 1e-9


@dataclass(slots=True, eq=False)
class ForgettingSums:
    """Exponentially forgotten sums over frames; ``w`` is a frame's weight.

    Parameters
    ----------
    cross
        ``sum w y z^T`` ``(n_slopes, n_modes)``.
    mixed
        ``sum w x z^T`` ``(n_modes, n_modes)``.
    pokes
        ``sum w z z^T`` ``(n_modes, n_modes)``.
    gram
        ``sum w^2 z z^T`` ``(n_modes, n_modes)``: the noise of the first.
    left
        ``sum w e e^T`` of the residual ``e = y - D x`` ``(n_slopes, n_slopes)``, or its diagonal
        ``(n_slopes,)`` above :data:`~escape_hw.calibration.docrime.open_loop.MAX_CORRELATED_SLOPES` slopes.
    weight
        ``sum w``.
    """

    cross: NDArray[np.float64]
    command_poke_products: NDArray[np.float64]
    pokes: NDArray[np.float64]
    gram: NDArray[np.float64]
    residual_products: NDArray[np.float64]
    weight: float = 0.0

    @classmethod
    def zeros(cls, n_slopes: int, n_modes: int) -> ForgettingSums:
        """Empty sums."""
        square = (n_slopes, n_slopes) if n_slopes <= MAX_CORRELATED_SLOPES else (n_slopes,)
        command_poke_products, pokes, gram = np.zeros((3, n_modes, n_modes))
        return cls(np.zeros((n_slopes, n_modes)), command_poke_products, pokes, gram, np.zeros(square))

    def forget(self, factor: float) -> None:
        """Let all frames so far count ``factor`` of what they did."""
        self.cross *= factor
        self.command_poke_products *= factor
        self.pokes *= factor
        self.gram *= factor**2
        self.residual_products *= factor
        self.weight *= factor

    def add(
        self,
        slopes: NDArray[np.float32],
        command: NDArray[np.float32],
        poke: NDArray[np.float32],
        matrix: NDArray[np.float32],
    ) -> None:
        """Add a block of whitened frames with weight 1.

        Parameters
        ----------
        slopes, command, poke
            ``y (n, n_slopes)``, ``x (n, n_modes)`` and ``z (n, n_modes)``; their means over the block,
            which are static aberrations, are taken out.
        matrix
            The best matrix known ``(n_slopes, n_modes)``, for the residual.
        """
        y, x, z = (part - part.mean(axis=0) for part in (slopes, command, poke))
        residual = y - x @ matrix.T
        self.cross += y.T @ z
        self.command_poke_products += x.T @ z
        gram = z.T @ z
        self.pokes += gram
        self.gram += gram
        self.residual_products += (
            residual.T @ residual
            if self.residual_products.ndim == 2
            else np.einsum("ts,ts->s", residual, residual)
        )
        self.weight += len(y)

    def merge(self, other: ForgettingSums) -> None:
        """Add the sums of other frames."""
        self.cross += other.cross
        self.command_poke_products += other.command_poke_products
        self.pokes += other.pokes
        self.gram += other.gram
        self.residual_products += other.residual_products
        self.weight += other.weight

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariance of one frame's residual ``(n_slopes, n_slopes)``, where it is followed."""
        return self.residual_products / self.weight if self.residual_products.ndim == 2 else None

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of one frame's residual ``(n_slopes,)``."""
        return np.asarray(
            (np.diag(self.residual_products) if self.residual_products.ndim == 2 else self.residual_products)
            / self.weight
        )

    def columns(self, template: InteractionMatrix, matrix: NDArray[np.float64]) -> InteractionMatrix:
        """The matrix that the sums hold, turned so that its columns have equal, independent noise.

        Parameters
        ----------
        frame
            Any matrix of this sensor and basis: its mask, basis and provenance are used.
        matrix
            The best matrix known ``(n_slopes, n_modes)``, for what the controller put in by chance.

        Returns
        -------
        InteractionMatrix
            ``(n_slopes, rank)``, with the modes turned alike; its modes have no unit rms any more.
        """
        # How much of a poke is seen of it in the end: the loop, too, answers to pokes.
        response_factor = float(np.median(np.diag(self.command_poke_products) / np.diag(self.pokes)))
        expected = response_factor * self.pokes
        cross = self.cross - matrix @ (self.command_poke_products - expected)
        return whiten_columns(template, cross, expected, self.gram, self.variance)


def whiten_columns(
    template: InteractionMatrix,
    cross: NDArray[np.float64],
    command_poke_products: NDArray[np.float64],
    gram: NDArray[np.float64],
    variance: NDArray[np.float64],
) -> InteractionMatrix:
    """Columns with equal, independent noise from sums with instruments; see the module.

    Parameters
    ----------
    frame
        Gives basis, mask and provenance.
    cross, mixed, gram
        As for :class:`ForgettingSums`.
    variance
        Variance of each slope's whitened noise in one frame ``(n_slopes,)``.
    """
    power, directions = np.linalg.eigh(gram)
    significant = power > MIN_POWER_RATIO * power.max()
    transform = directions[:, significant] / np.sqrt(power[significant])
    sigma = np.repeat(np.sqrt(variance)[:, None], transform.shape[1], axis=1)
    return replace(
        template,
        data=(cross @ transform).astype(np.float32),
        sigma=sigma.astype(np.float32),
        m2c=template.m2c @ (command_poke_products @ transform),
    )
