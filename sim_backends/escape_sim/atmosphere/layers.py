"""Open-air turbulence: layers that drift with the wind and boil, and a Fried parameter that changes."""

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
    lit_columns,
    spline_weights,
)

if TYPE_CHECKING:
    from escape_hw.config.twin import TwinAtmosphere, TwinSeeing


#: Angle in radians after which the correlation of a boiling layer has fallen to 1/e,
#: the solution of ``((pi - a) cos a + sin a) / pi = 1 / e``.
_DECAY_ANGLE = 1.474456


class TurbulentLayer:
    """A layer of frozen flow that boils: its realisation is gradually replaced by others.

    Two realisations are added with weights ``cos a`` and ``sin a``, which preserves the variance. A
    realisation is replaced when its weight is zero. The angle ``a`` grows at a constant rate from a
    random start. In a frame that moves with the wind the correlation after a growth of ``d`` is

        rho(d) = ((pi - d) cos d + sin d) / pi   for d < pi, and zero from then on,

    at all spatial scales. The layer at a time depends on the seed and that time only.

    Parameters
    ----------
    source, scale
        Draws the realisations, in radians; factor from radians to the unit of the output.
    wind_m_s
        Wind velocity (x, y) over the pupil in metres per second; x along columns, y along rows.
    boiling_s
        Time in seconds after which the correlation has fallen to 1/e; infinite for frozen flow. It is
        shortened where needed so that no realisation outlasts the wind's way across the screen.
    lit
        Samples ``(n, n)`` of the pupil that need values.
    executor
        Draws the next realisation in advance; None draws it when needed. The result is the same.

    Raises
    ------
    ValueError
        The screens' margin is too small for the pupil.
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
            raise ValueError(
                f"the screens have a margin of {source.margin} pixels; a pupil of {n} needs {n + 3}"
            )
        self._source, self._seed, self._executor = source, seed, executor
        self._scale, self._wind = scale, wind_m_s
        speed = math.hypot(*wind_m_s)
        crossing_s = (source.size - n) * source.pixel_m / speed if speed else math.inf
        #: Growth of the angle in radians per second; a realisation lasts pi radians.
        self.rate = max(_DECAY_ANGLE / boiling_s, math.pi / crossing_s)
        self._start = float(np.random.default_rng(seed).uniform(0, math.pi / 2))
        self._first, self._last = lit_columns(lit)
        self._line = np.empty(n + 3, np.float32)
        x = np.arange(n) * source.pixel_m
        self._along_x, self._along_y = (
            np.exp(2j * np.pi * np.outer(x, source.wave_frequencies[:, k])) for k in (0, 1)
        )
        self._drawn: dict[int, TurbulenceRealisation] = {}
        self._pending: dict[int, Future[TurbulenceRealisation]] = {}

    def add(self, time_s: float, out: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add ``strength`` times the layer at time ``time_s`` to ``out (n, n)``."""
        angle = self._start + self.rate * time_s
        quarter_turn = math.floor(angle / (math.pi / 2))
        angle -= quarter_turn * math.pi / 2
        one, two = self._current_pair(quarter_turn)
        weights_of_pair = np.array([math.cos(angle), math.sin(angle)]) * (self._scale * strength)
        # The turbulence moves with the wind, so the pupil moves upstream over the screen.
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
        """Add the waves longer than the screen without their value at the first sample.

        The piston of waves of many kilometres would cost precision in float32.
        """
        turns = self._source.wave_frequencies @ np.array(self._wind) * time_s
        current_amplitude = amplitude * np.exp(-2j * np.pi * (turns % 1.0))
        left, right = self._along_y * current_amplitude, self._along_x
        # The real part of a complex product as one real product of twice the inner size.
        parts = np.hstack([left.real, -left.imag, np.full((len(left), 1), -current_amplitude.real.sum())])
        out += (parts @ np.hstack([right.real, right.imag, np.ones((len(right), 1))]).T).astype(np.float32)

    def _current_pair(self, quarter_turn: int) -> tuple[TurbulenceRealisation, TurbulenceRealisation]:
        """The two realisations in use during a quarter turn; starts drawing the next one."""
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
        # Numbers are negative before time zero; spawn keys must not be.
        key = (*self._seed.spawn_key, 2 * number if number >= 0 else -2 * number - 1)
        seed = np.random.SeedSequence(self._seed.entropy, spawn_key=key)
        return self._source.draw(np.random.default_rng(seed))


#: Wavelength in metres that the Fried parameter refers to.
R0_WAVELENGTH_M = 500e-9
#: Smallest screen in pixels and in pupil diameters.
_MIN_SCREEN_PIXELS = 1024
_MIN_PUPILS_ACROSS = 8


def screen_pixels(n: int) -> int:
    """Pixels across the screens for a pupil of ``n`` pixels, a power of two."""
    return max(_MIN_SCREEN_PIXELS, 1 << math.ceil(math.log2(_MIN_PUPILS_ACROSS * n)))


class Atmosphere:
    """Sum of turbulent layers with boiling.

    The optical path is the same at all wavelengths. The Fried parameter is given at 500 nm.

    Each layer has its own stream of ``seed``. Only the ``lit`` samples ``(n, n)`` get values.
    """

    def __init__(
        self,
        settings: TwinAtmosphere,
        pixel_m: float,
        lit: NDArray[np.bool_],
        seed: np.random.SeedSequence,
    ) -> None:
        n = lit.shape[0]
        source = TurbulenceSource(screen_pixels(n), pixel_m, settings.r0_m, settings.outer_scale_m, n + 3)
        # The next screens are drawn in a thread; the turbulence is the same without.
        executor = ThreadPoolExecutor(1, "atmosphere") if helper_threads_allowed() else None
        self.layers: list[TurbulentLayer] = []
        for number, (fraction, speed, direction) in enumerate(
            zip(settings.fraction, settings.speed_m_s, settings.direction_deg, strict=True)
        ):
            angle = math.radians(direction)
            layer_seed = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number))
            wind = speed * math.cos(angle), speed * math.sin(angle)
            # The layers' variances are in proportion to the fractions.
            scale = math.sqrt(fraction) * R0_WAVELENGTH_M / (2 * math.pi)
            layer = TurbulentLayer(source, scale, wind, settings.boiling_s, lit, layer_seed, executor)
            self.layers.append(layer)

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add ``strength`` times the optical path at ``time_s`` to ``opd_m (n, n)``, in metres."""
        for layer in self.layers:
            layer.add(time_s, opd_m, strength)


class Seeing:
    """True Fried parameter relative to the start, as set by rate, sinusoid and limits of ``twin.seeing``."""

    def __init__(self, settings: TwinSeeing) -> None:
        self._settings = settings

    def r0(self, time_s: float) -> float:
        """Fried parameter at ``time_s`` of the twin's clock, relative to the start."""
        settings = self._settings
        unlimited = (
            1 + settings.rate * time_s + settings.swing * math.sin(2 * math.pi * time_s / settings.period_s)
        )
        return min(max(unlimited, settings.least), settings.most)

    def strength(self, time_s: float) -> float:
        """Factor on the optical path: ``r0^(-5/6)``, since its variance scales as ``r0^(-5/3)``."""
        return float(self.r0(time_s) ** (-5 / 6))
