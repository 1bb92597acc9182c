"""Open-air turbulence: layers that drift with the wind and boil, their sum above a telescope, and a Fried parameter that changes with time."""

from __future__ import annotations

import math
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import helper_threads_allowed
from escape_sim.atmosphere.von_karman import (
    TurbulenceRealisation,
    TurbulenceSource,
    add_two_screens,
    spline_weights,
)

if TYPE_CHECKING:
    from escape_hw.config.twin import TwinAtmosphere, TwinSeeing


#: Angle in radians after which the correlation of a boiling layer has fallen to 1/e,
#: the solution of ``((pi - a) cos a + sin a) / pi = 1 / e``.
_DECAY_ANGLE = 1.474456


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
        executor: Executor | None = None,
    ) -> None:
        n = lit.shape[0]
        if source.margin < n + 3:
            raise ValueError(f"screens with a margin of {source.margin} pixels; a pupil of {n} needs {n + 3}")
        self._source, self._seed, self._executor = source, seed, executor
        self._scale, self._wind = scale, wind_m_s
        speed = math.hypot(*wind_m_s)
        crossing_s = (source.size - n) * source.pixel_m / speed if speed else math.inf
        #: Growth of the angle in radians per second; a realisation lasts half a turn.
        self.rate = max(_DECAY_ANGLE / boiling_s, math.pi / crossing_s)
        self._start = float(np.random.default_rng(seed).uniform(0, math.pi / 2))
        self._first = np.where(lit.any(axis=1), lit.argmax(axis=1), 0)
        self._last = np.where(lit.any(axis=1), n - lit[:, ::-1].argmax(axis=1), 0)
        self._line = np.empty(n + 3, np.float32)
        x = np.arange(n) * source.pixel_m
        self._along_x, self._along_y = (
            np.exp(2j * np.pi * np.outer(x, source.wave_frequencies[:, k])) for k in (0, 1)
        )
        self._drawn: dict[int, TurbulenceRealisation] = {}
        self._pending: dict[int, Future[TurbulenceRealisation]] = {}

    @property
    def boiling_s(self) -> float:
        """Time in seconds after which the correlation has really fallen to 1/e."""
        return _DECAY_ANGLE / self.rate if self.rate else math.inf

    def add(self, time_s: float, out: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the layer at a moment, times ``strength``, to ``out (n, n)``."""
        angle = self._start + self.rate * time_s
        quarter_turn = math.floor(angle / (math.pi / 2))
        angle -= quarter_turn * math.pi / 2
        one, two = self._current_pair(quarter_turn)
        weights_of_pair = np.array([math.cos(angle), math.sin(angle)]) * (self._scale * strength)
        # The air moves, so the pupil reads ever further upstream.
        x, y = (-v * time_s / self._source.pixel_m for v in self._wind)
        column, row = math.floor(x), math.floor(y)
        weights = spline_weights(np.array([x - column, y - row])).astype(np.float32)
        add_two_screens(
            one.coefficients, two.coefficients, weights_of_pair.astype(np.float32), column, row,
            weights[0], weights[1], self._first, self._last, self._line, out,
        )  # fmt: skip
        if self._along_x.shape[1]:
            self._add_waves(time_s, weights_of_pair[0] * one.waves + weights_of_pair[1] * two.waves, out)

    def _add_waves(self, time_s: float, amplitude: NDArray[np.complex128], out: NDArray[np.float32]) -> None:
        """Add the waves longer than the screen, less their value at the first sample.

        No sensor sees the piston of a wave of many kilometres, but single precision would feel it.
        """
        turns = self._source.wave_frequencies @ np.array(self._wind) * time_s
        current_amplitude = amplitude * np.exp(-2j * np.pi * (turns % 1.0))
        left, right = self._along_y * current_amplitude, self._along_x
        # The real part of a complex product as one real product of twice the inner size.
        parts = np.hstack([left.real, -left.imag, np.full((len(left), 1), -current_amplitude.real.sum())])
        out += (parts @ np.hstack([right.real, right.imag, np.ones((len(right), 1))]).T).astype(np.float32)

    def _current_pair(self, quarter_turn: int) -> tuple[TurbulenceRealisation, TurbulenceRealisation]:
        """The realisations in use during a quarter of a turn; sees to it that the next will be there."""
        in_use = (quarter_turn, quarter_turn + 1)
        if in_use[0] not in self._drawn or in_use[1] not in self._drawn:
            self._drawn = {k: self._draw_or_fetch(k) for k in in_use}
            if self._executor is not None and self.rate:
                for stale in [k for k in self._pending if k != quarter_turn + 2]:
                    self._pending.pop(stale).cancel()
                if quarter_turn + 2 not in self._pending:
                    self._pending[quarter_turn + 2] = self._executor.submit(self._draw, quarter_turn + 2)
        return self._drawn[in_use[0]], self._drawn[in_use[1]]

    def _draw_or_fetch(self, number: int) -> TurbulenceRealisation:
        if number in self._drawn:
            return self._drawn[number]
        pending = self._pending.pop(number, None)
        return self._draw(number) if pending is None else pending.result()

    def _draw(self, number: int) -> TurbulenceRealisation:
        # Numbers are negative before time zero; a key must not be.
        key = (*self._seed.spawn_key, 2 * number if number >= 0 else -2 * number - 1)
        seed = np.random.SeedSequence(self._seed.entropy, spawn_key=key)
        return self._source.draw(np.random.default_rng(seed))


#: Wavelength in metres that the Fried parameter refers to, as is usual in astronomy.
R0_WAVELENGTH_M = 500e-9
#: Pixels across a screen: at least this many, and this many pupils.
_MIN_SCREEN_PIXELS = 1024
_MIN_PUPILS_ACROSS = 8


def screen_pixels(n: int) -> int:
    """Pixels across the screens for a pupil of ``n`` pixels, a power of two."""
    return max(_MIN_SCREEN_PIXELS, 1 << math.ceil(math.log2(_MIN_PUPILS_ACROSS * n)))


def _make_executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="atmosphere")


class Atmosphere:
    """Layered frozen flow with boiling.

    The optical path is the same at all wavelengths; the Fried parameter sets its strength at 500 nm
    and grows with the wavelength to the power of 6/5.

    Parameters
    ----------
    air
        Strength, outer scale, layers and boiling.
    pixel_m
        Size of a pupil sample in metres.
    lit
        Where the pupil needs values ``(n, n)``.
    seed
        Each layer has a stream of its own.
    background
        Draw the next screens in a thread of their own; the air is the same either way.
    """

    def __init__(
        self,
        settings: TwinAtmosphere,
        pixel_m: float,
        lit: NDArray[np.bool_],
        seed: np.random.SeedSequence,
        *,
        background: bool = True,
    ) -> None:
        n = lit.shape[0]
        source = TurbulenceSource(screen_pixels(n), pixel_m, settings.r0_m, settings.outer_scale_m, n + 3)
        executor = _make_executor() if background and helper_threads_allowed() else None
        self.layers: list[TurbulentLayer] = []
        for number, (fraction, speed, direction) in enumerate(
            zip(settings.fraction, settings.speed_m_s, settings.direction_deg, strict=True)
        ):
            angle = math.radians(direction)
            layer_seed = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number))
            self.layers.append(
                TurbulentLayer(
                    source,
                    # Variances of the layers add, and they are in proportion to the fractions.
                    math.sqrt(fraction) * R0_WAVELENGTH_M / (2 * math.pi),
                    (speed * math.cos(angle), speed * math.sin(angle)),
                    settings.boiling_s,
                    lit,
                    layer_seed,
                    executor,
                )
            )

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the optical path of a moment, times ``strength``, to ``opd_m (n, n)`` in metres."""
        for layer in self.layers:
            layer.add(time_s, opd_m, strength)


class Seeing:
    """Fried parameter and strength of the turbulence, relative to the start: hidden truth.

    Parameters
    ----------
    told
        Rate, sinusoid and limits.
    """

    def __init__(self, settings: TwinSeeing) -> None:
        self._settings = settings

    def r0(self, time_s: float) -> float:
        """Fried parameter at a time of the twin's clock, relative to the start."""
        settings = self._settings
        unlimited = (
            1 + settings.rate * time_s + settings.swing * math.sin(2 * math.pi * time_s / settings.period_s)
        )
        return min(max(unlimited, settings.least), settings.most)

    def strength(self, time_s: float) -> float:
        """Factor on the optical path: ``r0^(-5/6)``, for its variance goes with ``r0^(-5/3)``."""
        return float(self.r0(time_s) ** (-5 / 6))
