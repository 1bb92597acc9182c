"""Qt objects that pyqtgraph makes without an owner, and that would outlive their window."""

from __future__ import annotations

import pyqtgraph as pg


def own_menu(plot: pg.PlotItem) -> None:
    """Give a plot's menu, which nobody sees, to the widget that the plot stands in."""
    plot.setMenuEnabled(False)
    # Without its flags it would become a part of the widget, and be seen.
    plot.ctrlMenu.setParent(plot.getViewWidget(), plot.ctrlMenu.windowFlags())
