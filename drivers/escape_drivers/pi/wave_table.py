"""A circle as two wave tables: points, rate, and what the stage makes of them."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Up to so many points a table is written point by point, so that any phase is exact.
MAX_POINTWISE = 512


@dataclass(frozen=True, slots=True)
class CycleTiming:
    """How a turn is cut into points.

    Parameters
    ----------
    points
        Points of a wave table.
    rate
        Servo periods that each point lasts.
    """

    points: int
    rate: int

    @property
    def servo_periods(self) -> int:
        """Servo periods of a turn."""
        return self.points * self.rate

    def frequency_hz(self, servo_s: float) -> float:
        """Turns per second: the cycle lasts servo period x rate x points (E727T0005, wave generator)."""
        return 1 / (servo_s * self.servo_periods)


def nearest_timing(frequency_hz: float, servo_s: float, max_points: int) -> CycleTiming:
    """The turn nearest in duration; of equally near ones that with the most points.

    Long tables are drawn by the controller itself, whose quarter turn must be a whole number of points.
    """
    wanted = 1 / (frequency_hz * servo_s)
    least = max(1, math.ceil(round(wanted) / max_points))
    candidates = []
    for rate in range(max(1, least - 1), least + 2):
        exact = max(1, round(wanted / rate))
        points = exact if exact <= MAX_POINTWISE else min(4 * round(wanted / rate / 4), max_points // 4 * 4)
        if 1 <= points <= max_points:
            candidates.append(CycleTiming(points, rate))
    return min(candidates, key=lambda turn: (abs(turn.servo_periods - wanted), turn.rate))


def circle_targets(turn: CycleTiming, response: tuple[complex, complex]) -> NDArray[np.float64]:
    """Targets of the axes ``(points, 2)`` that make the stage draw a circle of radius 1 about (0, 0).

    Parameters
    ----------
    turn
        Points of the turn.
    response
        What the stage makes of a unit circle along x and y: amplitude and phase, positive when it leads.
    """
    angle = 2 * np.pi * np.arange(turn.points) / turn.points
    drive = [1 / response[0], -1j / response[1]]
    return np.stack([np.real(one * np.exp(1j * angle)) for one in drive], axis=1)


@dataclass(frozen=True, slots=True)
class SineTable:
    """A table that the controller draws itself (``SIN_P``): ``offset`` to ``offset + height`` and back."""

    height: float
    offset: float
    start: int


def fit_sine_table(turn: CycleTiming, wave: NDArray[np.float64]) -> SineTable:
    """The controller's sine nearest to a sampled one ``(points,)``; its phase to a point.

    The controller draws ``offset + height / 2 (1 - cos(2 pi (k - start) / points))`` (E727T0005, WAV).
    """
    (found,), (middle,) = fit_phasors(wave[:, None], turn.points)
    # A rounding error may not make a radius of zero negative.
    radius = float(abs(found))
    start = round((math.pi - cmath.phase(found)) / (2 * math.pi) * turn.points) % turn.points
    return SineTable(2 * radius, float(middle) - radius, start)


def evaluate_sine_table(turn: CycleTiming, sine: SineTable) -> NDArray[np.float64]:
    """What the controller makes of a sine ``(points,)``."""
    along = 2 * np.pi * (np.arange(turn.points) - sine.start) / turn.points
    return np.asarray(sine.offset + sine.height / 2 * (1 - np.cos(along)))


def fit_phasors(
    records: NDArray[np.float64], samples_per_turn: float
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Amplitude with phase, and mean, of recorded columns that go round once in ``samples_per_turn`` samples.

    Least squares on a constant, a cosine and a sine: exact for any length of a true circle.

    Parameters
    ----------
    records
        ``(samples, columns)``.

    Returns
    -------
    phasors : (columns,)
        ``a`` where the column is ``mean + Re(a exp(2 pi i k / samples_per_turn))``.
    means : (columns,)

    Raises
    ------
    ValueError
        The data cover less than a whole turn.
    """
    if len(records) < samples_per_turn:
        raise ValueError(f"{len(records)} samples are less than a turn of {samples_per_turn:g}")
    angle = 2 * np.pi * np.arange(len(records)) / samples_per_turn
    basis = np.stack([np.ones(len(records)), np.cos(angle), np.sin(angle)], axis=1)
    mean, cosine, sine = np.linalg.lstsq(basis, records, rcond=None)[0]
    return np.asarray(cosine - 1j * sine), np.asarray(mean)


def response_to_row(
    frequency_hz: float, response: tuple[complex, complex]
) -> tuple[float, float, float, float, float]:
    """A response as a row of ``stage.corrections``: frequency, amplitudes, lags in degrees."""
    lags = [-math.degrees(cmath.phase(value)) for value in response]
    return (frequency_hz, abs(response[0]), abs(response[1]), lags[0], lags[1])


def response_from_row(row: tuple[float, float, float, float, float]) -> tuple[complex, complex]:
    """Response of a row of ``stage.corrections``."""
    _, x, y, lag_x, lag_y = row
    return cmath.rect(x, -math.radians(lag_x)), cmath.rect(y, -math.radians(lag_y))
