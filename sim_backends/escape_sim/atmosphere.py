"""Open air above a telescope: layers of turbulence, each with its own wind."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.threads import helper_threads
from escape_sim.turbulent_layer import TurbulentLayer
from escape_sim.von_karman import TurbulenceSource

if TYPE_CHECKING:
    from escape_hw.config.twin_sky import TwinAtmosphere

#: Wavelength in metres that the Fried parameter refers to, as is usual in astronomy.
R0_WAVELENGTH_M = 500e-9
#: Pixels across a screen: at least this many, and this many pupils.
_LEAST_PIXELS = 1024
_PUPILS_ACROSS = 8


def screen_pixels(n: int) -> int:
    """Pixels across the screens for a pupil of ``n`` pixels, a power of two."""
    return max(_LEAST_PIXELS, 1 << math.ceil(math.log2(_PUPILS_ACROSS * n)))


def _worker() -> ThreadPoolExecutor:
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
        air: TwinAtmosphere,
        pixel_m: float,
        lit: NDArray[np.bool_],
        seed: np.random.SeedSequence,
        *,
        background: bool = True,
    ) -> None:
        n = lit.shape[0]
        source = TurbulenceSource(screen_pixels(n), pixel_m, air.r0_m, air.outer_scale_m, n + 3)
        worker = _worker() if background and helper_threads() else None
        self.layers: list[TurbulentLayer] = []
        for number, (fraction, speed, direction) in enumerate(
            zip(air.fraction, air.speed_m_s, air.direction_deg, strict=True)
        ):
            angle = math.radians(direction)
            own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number))
            self.layers.append(
                TurbulentLayer(
                    source,
                    # Variances of the layers add, and they are in proportion to the fractions.
                    math.sqrt(fraction) * R0_WAVELENGTH_M / (2 * math.pi),
                    (speed * math.cos(angle), speed * math.sin(angle)),
                    air.boiling_s,
                    lit,
                    own,
                    worker,
                )
            )

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the optical path of a moment, times ``strength``, to ``opd_m (n, n)`` in metres."""
        for layer in self.layers:
            layer.add(time_s, opd_m, strength)
