"""Strip chart: a quantity over the last minutes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_gui.theme import Theme
from escape_gui.widgets.plots.plot import Plot


class TimeSeriesBuffer:
    """Times and values of the last ``size`` entries."""

    def __init__(self, size: int) -> None:
        self._times = np.full(2 * size, np.nan)
        self._values = np.full(2 * size, np.nan)
        self._size, self._end = size, 0

    def add(self, time: float, value: float) -> None:
        """Add an entry; times in seconds, increasing."""
        if self._end == self._times.size:
            for buffer in (self._times, self._values):
                buffer[: self._size] = buffer[self._size :]
            self._end = self._size
        self._times[self._end], self._values[self._end] = time, value
        self._end += 1

    def clear(self) -> None:
        self._end = 0

    @property
    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times and values ``(n,)``, oldest first; views that the next :meth:`add` may overwrite."""
        part = slice(max(self._end - self._size, 0), self._end)
        return self._times[part], self._values[part]


class StripChart(Plot):
    """A quantity over the last ``span_s`` seconds."""

    def __init__(self, theme: Theme, name: str, y: str, span_s: float = 120.0, number: int = 0) -> None:
        super().__init__(theme, name, "time before now [s]", y)
        self.span_s = span_s
        self._line = self.curve(number, alone=True, connect="finite")
        self.setXRange(-span_s, 0, padding=0.0)
        self.getPlotItem().enableAutoRange(axis="y")
        self.pin_left_axis()

    def show_history(self, history: TimeSeriesBuffer, now: float) -> None:
        times, values = history.arrays
        recent = times > now - self.span_s
        self._line.setData(times[recent] - now, values[recent])
