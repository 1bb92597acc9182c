"""The panels, one per module, and their list ``PANELS``.

Their content is computed in ``views`` and drawn with ``widgets``; requests are sent by ``client``.
"""

from __future__ import annotations

from escape_gui.panels.base import Panel
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.devices import DevicesPanel
from escape_gui.panels.gains import GainsPanel
from escape_gui.panels.latency import LatencyPanel
from escape_gui.panels.log import LogPanel
from escape_gui.panels.loop import LoopPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.modes import ModesPanel
from escape_gui.panels.night import NightPanel
from escape_gui.panels.performance import PerformancePanel
from escape_gui.panels.procedure import ProcedurePanel
from escape_gui.panels.psf import PsfPanel
from escape_gui.panels.sprint import SprintPanel
from escape_gui.panels.telemetry import TelemetryPanel
from escape_gui.panels.trends import TrendsPanel

#: All panels, in the order of the View menu and of F6. A new panel is added here and in
#: :data:`escape_gui.window.docks.WORKSPACES`.
PANELS: tuple[type[Panel], ...] = (
    DevicesPanel, CameraPanel, MirrorPanel, ProcedurePanel, ModesPanel, SprintPanel, GainsPanel, LoopPanel,
    PerformancePanel, TrendsPanel, TelemetryPanel, PsfPanel, LatencyPanel, LogPanel, NightPanel,
)  # fmt: skip
