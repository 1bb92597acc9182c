"""Histogram of durations, with a logarithmic axis of counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtGui import QFontMetricsF

from escape_gui.theme import Theme
from escape_gui.widgets.plots import Plot
from escape_hw.streams.timing import MIDDLES, percentiles_of

#: Percentile at the end of the axis, and the largest ratio of that end to the median.
_LAST_PERCENTILE, _MAX_TO_MEDIAN = 99.9, 5.0
#: Height of a bin without counts on the logarithmic axis.
_ZERO_COUNT = 0.5
#: Least count at the top of the axis, and room above the highest bin without and with a text, decades.
_LEAST_TOP, _HEADROOM, _TEXT_HEADROOM = 2, 0.15, 0.5
#: Counts from which the numbers of the axis are powers of ten.
_POWERS_FROM = 10_000
_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


class CountAxis(pg.AxisItem):  # type: ignore[misc]
    """A vertical logarithmic axis whose numbers are whole counts, as many as there is room for."""

    def tickValues(self, low: float, high: float, size: float) -> list[tuple[float, list[float]]]:
        room = QFontMetricsF(self.style["tickFont"] or self.font()).height()
        decade = size / max(high - low, 1e-9)
        digits = (1, 2, 5) if decade * math.log10(2) >= room else (1,)
        step = max(1, math.ceil(room / decade))
        powers = range(0, max(0, math.ceil(high)) + 1, step)
        values = [power + math.log10(digit) for power in powers for digit in digits]
        return [(1.0, [value for value in values if low <= value <= high])]

    def tickStrings(self, values: Sequence[float], scale: float, spacing: float) -> list[str]:
        return [_count_text(round(10**value)) for value in values]


def _count_text(count: int) -> str:
    if count < _POWERS_FROM:
        return str(count)
    power = int(math.log10(count))
    digit = round(count / 10**power)
    return f"{'' if digit == 1 else f'{digit}·'}10{str(power).translate(_SUPERSCRIPTS)}"


class HistogramPlot(Plot):
    """Counts by bin of durations in microseconds.

    The axis ends at the 99.9th percentile or at five times the median, whichever is smaller (the latter with
    few counts and an outlier); the plot states the number of counts beyond.
    """

    def __init__(self, theme: Theme, name: str, x: str, number: int) -> None:
        super().__init__(theme, name, x, "frames", left=CountAxis("left"))
        self.setLogMode(x=False, y=True)
        # Room for the upper half of the highest tick label.
        self.getPlotItem().layout.setContentsMargins(1, 8, 1, 1)
        self._curve = self.curve(number, alone=True, stepMode="center", connect="finite")
        self._beyond = pg.TextItem(anchor=(1, 0))
        self.addItem(self._beyond, ignoreBounds=True)
        self.show_counts(np.zeros(MIDDLES.size))

    def show_counts(self, counts: NDArray[Any]) -> None:
        """Show the counts ``(BINS,)``."""
        used = np.flatnonzero(counts)
        self.getAxis("bottom").setStyle(showValues=bool(used.size))
        self.getAxis("left").setStyle(showValues=bool(used.size))
        if not used.size:
            self._curve.setData([1.0, 2.0], [np.nan])
            self._beyond.setText("")
            return
        median, last_shown = percentiles_of(counts, (50.0, _LAST_PERCENTILE))
        shown = used[MIDDLES[used] <= min(last_shown, _MAX_TO_MEDIAN * median)]
        # An empty bin on both sides.
        first, last = max(int(shown[0]) - 1, 1), min(int(shown[-1]) + 2, MIDDLES.size - 1)
        middles = MIDDLES[first - 1 : last + 1] / 1e3
        edges = (middles[:-1] + middles[1:]) / 2
        self._curve.setData(edges, np.maximum(counts[first:last], _ZERO_COUNT))
        total, beyond = round(float(counts.sum())), round(float(counts[last:].sum()))
        headroom = _TEXT_HEADROOM if beyond else _HEADROOM
        top = math.log10(max(float(counts.max()), _LEAST_TOP)) + headroom
        self.setYRange(math.log10(_ZERO_COUNT), top, padding=0)
        self.setXRange(float(edges[0]), float(edges[-1]), padding=0)
        self._beyond.setText(f"{beyond} of {total} beyond" if beyond else "", color=self._theme.colours.muted)
        self._beyond.setFont(self._theme.font(0.85))
        self._beyond.setPos(float(edges[-1]), top)
