"""The registration over minutes and hours, since tracking began."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PySide6.QtWidgets import QVBoxLayout, QWidget

from escape_gui.theme import Theme
from escape_gui.views.convergence import GROUPS, Drift, short_unit
from escape_gui.widgets.convergence_plot import AXIS
from escape_gui.widgets.curve_plot import Band, add_plot, clear, line_at, style_axis


class DriftPlot(QWidget):
    """Change of shift, rotation and scaling since the first look, with their errors.

    Parameters
    ----------
    theme
        Colours and fonts.
    """

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._drift = Drift.of(np.zeros((0, 11)))
        self._grid = pg.GraphicsLayoutWidget()
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._grid)
        theme.changed.connect(self._build)
        self._build()

    def show_drift(self, drift: Drift) -> None:
        """Show this course."""
        rebuilt = drift.marks != self._drift.marks or drift.unit != self._drift.unit
        self._drift = drift
        if rebuilt:
            self._build()
        else:
            self._fill()

    def _build(self) -> None:
        clear(self._grid)
        self._grid.setBackground(self._theme.colour("field"))
        self._bands: dict[int, Band] = {}
        for row, (title, unit, members) in enumerate(GROUPS):
            plot = add_plot(self._grid, row)
            last = row == len(GROUPS) - 1
            style_axis(
                self._theme, plot.getAxis("left"), f"Δ {title.lower()}", short_unit(unit), stacked=True
            )
            plot.getAxis("left").setWidth(self._theme.pixels(AXIS))
            style_axis(self._theme, plot.getAxis("bottom"), *(("Time", self._drift.unit) if last else ("",)))
            plot.getAxis("bottom").setStyle(showValues=last)
            for member in members:
                self._bands[member] = Band(self._theme.series(member), width=1.0)
                self._bands[member].add_to(plot)
            for at, _ in self._drift.marks:
                plot.addItem(line_at(self._theme, at, horizontal=False))
        self._fill()

    def _fill(self) -> None:
        change = self._drift.since_start()
        for member, band in self._bands.items():
            band.set(self._drift.time, change[:, member], self._drift.sigma[:, member])
