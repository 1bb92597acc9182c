"""Optical gains of every mode, by matrix, with the rounds of their bootstrap."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QCheckBox, QHBoxLayout, QLabel

from escape_gui.client.product_library import LoadedProducts
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.gain_curves import GainCurve, live_curve
from escape_gui.widgets.plots.gains import GainsPlot
from escape_gui.widgets.plots.plot import MARKERS
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import METHOD_LABELS


class GainsPanel(Panel):
    """Points with error bars and their smooth course, on two axes where they need them."""

    name = "gains"
    title = "Optical gains"
    help = (
        "How strongly the sensor answers on the wavefront it works on, mode by mode, relative to each "
        "matrix: points as measured with their errors, and a smooth course. Matrices below 1 are read on the "
        "left, those above 1, measured in open loop, on the right."
    )
    streams: ClassVar[tuple[str, ...]] = ("gains", "gains_sigma", "gains_smooth", "gains_rounds")
    rate_hz = 5.0
    placeholder = (
        "No optical gains yet.\n\nCalibrate first, then start Optical gains in the Procedure panel. "
        "Or open a product or a run folder (Ctrl+O)."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._live: dict[str, NDArray[Any]] = {}
        self._label = "as measured now"
        self._loaded = LoadedProducts()
        self._running = self._dirty = False
        self._curves: dict[str, GainCurve] = {}
        self.plot = GainsPlot(context.theme)
        self.rounds = QCheckBox("Rounds")
        self.rounds.setChecked(True)
        self.rounds.setToolTip("Draw the earlier rounds of the bootstrap as thin lines.")
        self.rounds.toggled.connect(self.plot.show_rounds)
        self._legend = QLabel()
        self._legend.setWordWrap(True)
        row = QHBoxLayout()
        row.addWidget(self._legend, 1)
        row.addWidget(self.rounds)
        self.body.addLayout(row)
        self.body.addWidget(self.plot, 1)
        self.setFocusProxy(self.rounds)

    def on_state(self, state: State) -> None:
        """Follow what the server holds."""
        self._running = state.active_run is not None
        self.context.session.library.request(state.products)

    def on_sample(self, stream: str, sample: Sample) -> None:
        """The gains are measured."""
        self._live[stream] = sample.data
        method = str(sample.meta.get("method", ""))
        self._label = METHOD_LABELS.get(method, method) or self._label
        self._dirty = True

    def tick(self, source: DataSource) -> None:
        """Draw when anything is new."""
        loaded = self.context.session.library.loaded
        if loaded is not self._loaded:
            self._loaded, self._dirty = loaded, True
        if not self._dirty:
            return
        self._dirty = False
        self._curves = self._collect_curves()
        if self._curves:
            self.show_placeholder(False)
            self.plot.show_curves(self._curves)
            self._update_legend()

    def _collect_curves(self) -> dict[str, GainCurve]:
        """Curves by label, those of measured matrices first; a living one before its saved self."""
        found = dict(self._loaded.gains)
        gains = self._live.get("gains")
        if gains is not None and (self._running or self._label not in found):
            found[self._label] = live_curve(
                self._label,
                gains,
                *(self._live.get(f"gains_{name}") for name in ("sigma", "smooth", "rounds")),
            )
        return dict(sorted(found.items(), key=lambda item: item[1].median))

    def _update_legend(self) -> None:
        on, lines = self.plot.labels, []
        for k, (label, curve) in enumerate(self._curves.items()):
            side = f", {on[label]} axis" if len(set(on.values())) > 1 else ""
            rounds = f", {len(curve.rounds)} rounds" if len(curve.rounds) > 1 else ""
            mean = f"median {curve.median:.3f}" if np.isfinite(curve.median) else "no smooth course yet"
            colour = self.context.theme.series(k).name()
            sign = f"<span style='color:{colour}'>{MARKERS[k % len(MARKERS)][1]}</span>"
            lines.append(f"{sign} {label}: {mean}{side}{rounds}")
        self._legend.setText("<br>".join(lines))

    def clear(self) -> None:
        """Forget the gains of another source."""
        self._live.clear()
        self._curves = {}

    def apply_theme(self) -> None:
        """The legend's signs have the curves' colours."""
        self._update_legend()

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """A table for every curve."""
        heads = ("mode", "gain", "sigma", "smooth", "smooth_sigma")
        return tuple(
            ExportArray(
                f"gains_{number}" if number else "gains",
                np.column_stack([one.modes, one.value, one.sigma, one.trend, one.trend_sigma]),
                columns=heads,
            )
            for number, one in enumerate(self._curves.values())
        )
