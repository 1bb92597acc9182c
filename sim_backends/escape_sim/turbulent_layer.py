"""One layer of turbulent air: it drifts with the wind, boils, and never comes again."""

from __future__ import annotations

import math
from concurrent.futures import Executor, Future

import numpy as np
from numpy.typing import NDArray

from escape_sim.spline import read_two, spline_weights
from escape_sim.von_karman import Realisation, TurbulenceSource

#: Angle in radians after which the correlation of a boiling layer has fallen to 1/e,
#: the solution of ``((pi - a) cos a + sin a) / pi = 1 / e``.
_DECAY = 1.474456


class TurbulentLayer:
    """A layer of frozen flow whose realisation is slowly exchanged for others.

    Two realisations are read at the same place with weights ``cos a`` and ``sin a``, so the
    variance is exact at every moment. Whenever one of them has weight zero the next takes its
    place. With the angle ``a`` growing at a constant rate from a random start, the correlation
    after a time in which the angle grows by ``d`` is, in air that moves along with the wind,

        rho(d) = ((pi - d) cos d + sin d) / pi   for d < pi, and zero from then on,

    the same at all spatial scales. The layer at a moment is a function of the seed and of that moment
    alone, whatever was asked before.

    Parameters
    ----------
    source
        Draws the realisations, in radians.
    scale
        Factor from radians to the unit of the output.
    wind_m_s
        Velocity (x, y) of the air over the pupil in metres per second; x along columns, y along rows.
    boiling_s
        Time after which the correlation has fallen to 1/e, in seconds; infinite for air that keeps its
        shape. Air that would meet itself again is renewed sooner: no realisation lasts longer than the
        wind needs to carry the pupil across the screen.
    lit
        Where the pupil needs values ``(n, n)``.
    seed
        Of this layer.
    worker
        Where the next realisation is drawn while the present ones are in use; ``None`` draws it when
        it is needed. Both give the same air.
    """

    def __init__(
        self,
        source: TurbulenceSource,
        scale: float,
        wind_m_s: tuple[float, float],
        boiling_s: float,
        lit: NDArray[np.bool_],
        seed: np.random.SeedSequence,
        worker: Executor | None = None,
    ) -> None:
        n = lit.shape[0]
        if source.margin < n + 3:
            raise ValueError(f"screens with a margin of {source.margin} pixels; a pupil of {n} needs {n + 3}")
        self._source, self._seed, self._worker = source, seed, worker
        self._scale, self._wind = scale, wind_m_s
        speed = math.hypot(*wind_m_s)
        crossing_s = (source.size - n) * source.pixel_m / speed if speed else math.inf
        #: Growth of the angle in radians per second; a realisation lasts half a turn.
        self.rate = max(_DECAY / boiling_s, math.pi / crossing_s)
        self._start = float(np.random.default_rng(seed).uniform(0, math.pi / 2))
        self._first = np.where(lit.any(axis=1), lit.argmax(axis=1), 0)
        self._last = np.where(lit.any(axis=1), n - lit[:, ::-1].argmax(axis=1), 0)
        self._line = np.empty(n + 3, np.float32)
        x = np.arange(n) * source.pixel_m
        self._along_x, self._along_y = (
            np.exp(2j * np.pi * np.outer(x, source.wave_frequencies[:, k])) for k in (0, 1)
        )
        self._drawn: dict[int, Realisation] = {}
        self._pending: dict[int, Future[Realisation]] = {}

    @property
    def boiling_s(self) -> float:
        """Time in seconds after which the correlation has really fallen to 1/e."""
        return _DECAY / self.rate if self.rate else math.inf

    def add(self, time_s: float, out: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the layer at a moment, times ``strength``, to ``out (n, n)``."""
        angle = self._start + self.rate * time_s
        quarter = math.floor(angle / (math.pi / 2))
        angle -= quarter * math.pi / 2
        one, two = self._pair(quarter)
        share = np.array([math.cos(angle), math.sin(angle)]) * (self._scale * strength)
        # The air moves, so the pupil reads ever further upstream.
        x, y = (-v * time_s / self._source.pixel_m for v in self._wind)
        column, row = math.floor(x), math.floor(y)
        weights = spline_weights(np.array([x - column, y - row])).astype(np.float32)
        read_two(
            one.coefficients, two.coefficients, share.astype(np.float32), column, row,
            weights[0], weights[1], self._first, self._last, self._line, out,
        )  # fmt: skip
        if self._along_x.shape[1]:
            self._add_waves(time_s, share[0] * one.waves + share[1] * two.waves, out)

    def _add_waves(self, time_s: float, amplitude: NDArray[np.complex128], out: NDArray[np.float32]) -> None:
        """Add the waves longer than the screen, less their value at the first sample.

        No sensor sees the piston of a wave of many kilometres, but single precision would feel it.
        """
        turns = self._source.wave_frequencies @ np.array(self._wind) * time_s
        now = amplitude * np.exp(-2j * np.pi * (turns % 1.0))
        left, right = self._along_y * now, self._along_x
        # The real part of a complex product as one real product of twice the inner size.
        parts = np.hstack([left.real, -left.imag, np.full((len(left), 1), -now.real.sum())])
        out += (parts @ np.hstack([right.real, right.imag, np.ones((len(right), 1))]).T).astype(np.float32)

    def _pair(self, quarter: int) -> tuple[Realisation, Realisation]:
        """The realisations in use during a quarter of a turn; sees to it that the next will be there."""
        wanted = (quarter, quarter + 1)
        if wanted[0] not in self._drawn or wanted[1] not in self._drawn:
            self._drawn = {k: self._draw_or_fetch(k) for k in wanted}
            if self._worker is not None and self.rate:
                for stale in [k for k in self._pending if k != quarter + 2]:
                    self._pending.pop(stale).cancel()
                if quarter + 2 not in self._pending:
                    self._pending[quarter + 2] = self._worker.submit(self._draw, quarter + 2)
        return self._drawn[wanted[0]], self._drawn[wanted[1]]

    def _draw_or_fetch(self, number: int) -> Realisation:
        if number in self._drawn:
            return self._drawn[number]
        pending = self._pending.pop(number, None)
        return self._draw(number) if pending is None else pending.result()

    def _draw(self, number: int) -> Realisation:
        # Numbers are negative before time zero; a key must not be.
        key = (*self._seed.spawn_key, 2 * number if number >= 0 else -2 * number - 1)
        seed = np.random.SeedSequence(self._seed.entropy, spawn_key=key)
        return self._source.draw(np.random.default_rng(seed))
