"""Optical gains by mode and matrix, with the rounds of the bootstrap."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from PySide6.QtWidgets import QCheckBox

from escape_gui.client.product_library import LoadedProducts
from escape_gui.panels.base import Context, ExportArray, Panel
from escape_gui.views.gain_curves import GainCurve, live_curve
from escape_gui.widgets.controls import row, text_label
from escape_gui.widgets.plots import MARKERS, GainsPlot
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import State
from escape_hw.report.tables import METHOD_LABELS


class GainsPanel(Panel):
    """Optical gains with error bars and their trend, on two axes if necessary."""

    name = "gains"
    title = "Optical gains"
    tab_title: ClassVar[str] = "Gains"
    help = (
        "Sensitivity of the sensor in operation, by mode, relative to each matrix: measured gains with error "
        "bars, and their trend over the modes. If some matrices have gains below 1 and others, measured in "
        "open loop, gains above 1, the latter have an axis of their own on the right."
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
        self._label = "live"
        self._loaded = LoadedProducts()
        self._running = False
        self._curves: dict[str, GainCurve] = {}
        self.plot = GainsPlot(context.theme)
        self.rounds = QCheckBox("Rounds")
        self.rounds.setChecked(True)
        self.rounds.setToolTip("Draw the earlier rounds of the bootstrap as thin lines.")
        self.rounds.toggled.connect(self.plot.show_rounds)
        self._legend = text_label()
        self.body.addLayout(row((self._legend, 1), self.rounds))
        self.body.addWidget(self.plot, 1)
        self.setFocusProxy(self.rounds)

    def on_state(self, state: State) -> None:
        self._running = state.active_run is not None
        self.context.session.library.request(state.products)

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._live[stream] = sample.data
        method = str(sample.meta.get("method", ""))
        self._label = METHOD_LABELS.get(method, method) or self._label
        self.dirty = True

    def tick(self, source: DataSource) -> None:
        loaded = self.context.session.library.loaded
        if loaded is not self._loaded:
            self._loaded, self.dirty = loaded, True

    def redraw(self) -> None:
        self._curves = self._collect_curves()
        if self._curves:
            self.show_placeholder(False)
            self.plot.show_curves(self._curves)
            self._update_legend()

    def _collect_curves(self) -> dict[str, GainCurve]:
        """Curves by label in order of their medians; the live curve replaces a product of its label."""
        curves = dict(self._loaded.gains)
        gains = self._live.get("gains")
        if gains is not None and (self._running or self._label not in curves):
            curves[self._label] = live_curve(
                self._label,
                gains,
                *(self._live.get(f"gains_{name}") for name in ("sigma", "smooth", "rounds")),
            )
        return dict(sorted(curves.items(), key=lambda item: item[1].median))

    def _update_legend(self) -> None:
        sides, lines = self.plot.labels, []
        for k, (label, curve) in enumerate(self._curves.items()):
            side = f", {sides[label]} axis" if len(set(sides.values())) > 1 else ""
            rounds = f", {len(curve.rounds)} rounds" if len(curve.rounds) > 1 else ""
            median = f"median {curve.median:.3f}" if np.isfinite(curve.median) else "no trend yet"
            colour = self.context.theme.series(k).name()
            marker = f"<span style='color:{colour}'>{MARKERS[k % len(MARKERS)][1]}</span>"
            lines.append(f"{marker} {label}: {median}{side}{rounds}")
        self._legend.setText("<br>".join(lines))

    def clear(self) -> None:
        self._live.clear()
        self._curves = {}
        # The products of a source that goes on are shown again.
        self._loaded = LoadedProducts()

    def apply_theme(self) -> None:
        self._update_legend()

    def export_arrays(self) -> tuple[ExportArray, ...]:
        columns = ("mode", "gain", "sigma", "smooth", "smooth_sigma")
        return tuple(
            ExportArray(
                f"gains_{number}" if number else "gains",
                np.column_stack([one.modes, one.value, one.sigma, one.trend, one.trend_sigma]),
                columns=columns,
            )
            for number, one in enumerate(self._curves.values())
        )
