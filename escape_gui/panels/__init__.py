"""The panels, one in a file, and the list of them."""

from __future__ import annotations

from escape_gui.panels.devices import DevicesPanel
from escape_gui.panels.panel import Panel

#: All panels, in the order in which the View menu and F6 go through them. A panel is added here and
#: in :data:`escape_gui.workspaces.WORKSPACES`.
PANELS: tuple[type[Panel], ...] = (DevicesPanel,)
