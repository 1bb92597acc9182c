"""Sequences of modal pokes, one per frame, that know nothing of the turbulence."""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.models import Pokes

#: How strongly shaped pokes alternate in sign. More gains little (:func:`~.pokes.information_gain`) and asks
#: the mirror for ever larger steps.
ALTERNATING = 0.6


class Pattern(Protocol):
    """Makes pokes from the amplitude of each mode ``(n_modes,)`` and a random generator.

    Attributes
    ----------
    method, title
        What a measurement with these pokes is called, in products and to people.
    """

    method: ClassVar[str]
    title: ClassVar[str]

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None: ...

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        ...


class RandomPokes:
    """Every mode in every frame, uniform and independent (DO-CRIME; Lai et al. 2020).

    Parameters
    ----------
    amplitude
        Pokes of each mode lie within plus and minus this ``(n_modes,)``.
    rng
        Where they come from.
    """

    method: ClassVar[str] = "docrime"
    title: ClassVar[str] = "DO-CRIME"

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._amplitude, self._rng = amplitude, rng

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        return self._amplitude * self._rng.uniform(-1.0, 1.0, self._amplitude.size)


class AlternatingPokes(RandomPokes):
    """As :class:`RandomPokes`, with signs that change more often than not: where turbulence is weak.

    Each poke is correlated with the one before by minus :data:`ALTERNATING`, a first-order
    autoregression of the same rms; the modes stay independent of each other and of the turbulence.
    """

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        super().__init__(amplitude, rng)
        self._last: NDArray[np.float64] | None = None

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        fresh = super().__call__()
        if self._last is not None:
            fresh = np.sqrt(1 - ALTERNATING**2) * fresh - ALTERNATING * self._last
        self._last = fresh
        return fresh


def random_pattern(kind: Pokes) -> type[Pattern]:
    """The random pokes that the configuration asks for (``calibration.pokes``)."""
    return AlternatingPokes if kind == "shaped" else RandomPokes


class PushPullPokes:
    """One mode at a time, pushed and pulled from frame to frame, the modes in a new order every round.

    Fast push-pull: neither frame waits for the mirror to settle or for the turbulence to average out;
    which slopes belong to which poke is a matter of the estimator, as with random pokes. The random
    order keeps what the turbulence does in one round from meeting the same mode in the next.

    Parameters
    ----------
    amplitude
        Push and pull of each mode ``(n_modes,)``.
    rng
        Decides the order.
    """

    method: ClassVar[str] = "push-pull-fast"
    title: ClassVar[str] = "fast push-pull"

    def __init__(self, amplitude: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._amplitude, self._rng = amplitude, rng
        self._queue: list[tuple[int, float]] = []
        self._poke = np.zeros(amplitude.size)

    def __call__(self) -> NDArray[np.float64]:
        """Poke of the next frame ``(n_modes,)``."""
        if not self._queue:
            for mode in self._rng.permutation(self._amplitude.size):
                # Which comes first is drawn, too: the sign of a poke tells nothing of the one before.
                sign = float(self._rng.choice((-1.0, 1.0)))
                self._queue += [(int(mode), sign), (int(mode), -sign)]
            self._queue.reverse()
        mode, sign = self._queue.pop()
        self._poke[:] = 0.0
        self._poke[mode] = sign * self._amplitude[mode]
        return self._poke
