"""Profile of the influence functions that SPRINT has found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_gui.theme import Theme
from escape_gui.widgets.plots import ErrorBand, PlotGrid, style_axis

#: Curves: label, values and errors in the document, and number of the colour.
_CURVES = (("nominal", "nominal", "", 2), ("fitted", "fitted", "sigma", 0), ("edge", "edge", "edge_sigma", 1))


class ProfilePlot(PlotGrid):
    """Nominal and fitted profile, of inner and of edge actuators, with bands of their standard errors."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._profile: Mapping[str, Any] = {}
        self.setAccessibleName("Profile of the influence functions")
        self.build()

    def show_profile(self, profile: Mapping[str, Any] | None) -> None:
        """Show the profile of a result document; ``None``: an empty plot."""
        self._profile = profile or {}
        self._fill()

    def build(self) -> None:
        super().build()
        plot = self.add_plot()
        style_axis(self._theme, plot.getAxis("bottom"), "Distance from the actuator [pitches]")
        style_axis(self._theme, plot.getAxis("left"), "Surface / peak")
        legend = plot.addLegend(offset=(-8, 8), labelTextColor=self._theme.colour("text"))
        self.bands = [ErrorBand(self._theme.series(number)) for _, _, _, number in _CURVES]
        for band, (label, *_) in zip(self.bands, _CURVES, strict=True):
            band.add_to(plot)
            legend.addItem(band.line, label)
        self._fill()

    def _fill(self) -> None:
        radius = self._values("radius")
        for band, (_, name, errors, _) in zip(self.bands, _CURVES, strict=True):
            values, sigma = self._values(name), self._values(errors)
            missing = np.full(values.size, np.nan)
            band.set(radius[: values.size], values, sigma if sigma.size else missing)

    def _values(self, name: str) -> NDArray[np.float64]:
        return np.array(self._profile.get(name, ()), float)
