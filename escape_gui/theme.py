"""Theme of the window: a dark and a light palette, fonts, and Qt's style sheet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from PySide6.QtCore import QObject, Signal
from PySide6.QtGui import QColor, QFont, QFontDatabase, QPalette
from PySide6.QtWidgets import QApplication, QStyleFactory

PaletteName = Literal["dark", "light"]
#: Font scales that Ctrl +/- steps through.
SCALES = (0.8, 0.9, 1.0, 1.1, 1.25, 1.4, 1.6, 1.8, 2.0)
_POINTS = 9.5
_SANS = ("Inter", "Noto Sans", "DejaVu Sans", "Liberation Sans")
_MONO = ("JetBrains Mono", "Noto Sans Mono", "DejaVu Sans Mono", "Liberation Mono")


@dataclass(frozen=True, slots=True)
class Palette:
    """Colours of a theme. Text has a contrast of at least 4.5 : 1 on every surface that it is used on."""

    #: Surfaces from back to front: window, panel, plots and fields, buttons.
    window: str
    panel: str
    field: str
    button: str
    line: str
    text: str
    muted: str
    accent: str
    on_accent: str
    #: Conditions, used for text and shapes on any surface.
    good: str
    warn: str
    bad: str
    #: Connection banner and its text.
    simulated: str
    on_simulated: str
    hardware: str
    on_hardware: str
    replay: str
    on_replay: str
    #: Safety buttons.
    stop: str
    on_stop: str
    #: Curves, after Okabe and Ito: distinguishable with any colour vision.
    series: tuple[str, ...]


# fmt: off
DARK = Palette(
    window="#131517", panel="#1a1d20", field="#0e1012", button="#2a2f34",
    line="#353b41", text="#e4e7ea", muted="#9aa4ad", accent="#56b4e9", on_accent="#06141d",
    good="#3fc79a", warn="#f0b429", bad="#ff7a6b",
    simulated="#1f3d52", on_simulated="#d6edfb", hardware="#e69f00", on_hardware="#171000",
    replay="#6d3fa0", on_replay="#ffffff",
    stop="#b3261e", on_stop="#ffffff",
    series=("#56b4e9", "#e69f00", "#2bbf94", "#e08fbb", "#f0e442", "#ff8f4d"),
)
LIGHT = Palette(
    window="#e9ebed", panel="#f6f7f8", field="#ffffff", button="#dde1e5",
    line="#b9c0c7", text="#15191d", muted="#4d5760", accent="#005f9e", on_accent="#ffffff",
    good="#00634a", warn="#7d4e00", bad="#b3261e",
    simulated="#cfe5f4", on_simulated="#0b3550", hardware="#ffc04d", on_hardware="#241800",
    replay="#6d3fa0", on_replay="#ffffff",
    stop="#b3261e", on_stop="#ffffff",
    series=("#0072b2", "#b85c00", "#00795a", "#a84a82", "#7a6f00", "#444c54"),
)
# fmt: on
PALETTES: dict[PaletteName, Palette] = {"dark": DARK, "light": LIGHT}


class Theme(QObject):
    """Palette and font scale (within :data:`SCALES`); :attr:`changed` is emitted when either changes."""

    changed = Signal()

    def __init__(self, palette_name: PaletteName = "dark", scale: float = 1.0) -> None:
        super().__init__()
        self.palette_name: PaletteName = palette_name
        self.scale = min(max(scale, SCALES[0]), SCALES[-1])

    def follow(self, apply: Callable[[], object]) -> None:
        """Call a function now and at every change."""
        self.changed.connect(apply)
        apply()

    @property
    def colours(self) -> Palette:
        return PALETTES[self.palette_name]

    def colour(self, name: str) -> QColor:
        """A colour of the palette by its field name."""
        return QColor(str(getattr(self.colours, name)))

    def series(self, number: int) -> QColor:
        """Colour of curve ``number``, cyclic."""
        names = self.colours.series
        return QColor(names[number % len(names)])

    def set_palette(self, palette_name: PaletteName) -> None:
        if palette_name != self.palette_name:
            self.palette_name = palette_name
            self.apply()

    def step_scale(self, steps: int) -> None:
        """Increase (+1) or decrease (-1) the font scale by a step; 0: reset it."""
        nearest = min(range(len(SCALES)), key=lambda k: abs(SCALES[k] - self.scale))
        chosen = SCALES[min(max(nearest + steps, 0), len(SCALES) - 1)] if steps else 1.0
        if chosen != self.scale:
            self.scale = chosen
            self.apply()

    def font(self, size: float = 1.0, *, mono: bool = False, bold: bool = False) -> QFont:
        """A font of ``size`` times the normal size; ``mono`` for numbers that change."""
        font = QFont(_family(_MONO if mono else _SANS, mono))
        font.setPointSizeF(_POINTS * self.scale * size)
        font.setBold(bold)
        return font

    def pixels(self, at_normal_size: float) -> int:
        """A length in pixels, scaled like the fonts."""
        return round(at_normal_size * self.scale)

    def apply(self) -> None:
        """Set palette, font and style sheet of the application, unless it has them (a second window)."""
        application = QApplication.instance()
        font, sheet = self.font(), style_sheet(self)
        if isinstance(application, QApplication) and (application.font(), application.styleSheet()) != (
            font,
            sheet,
        ):
            application.setStyle(QStyleFactory.create("Fusion"))
            application.setPalette(qt_palette(self.colours))
            application.setFont(font)
            application.setStyleSheet(sheet)
        self.changed.emit()


def _family(wanted: tuple[str, ...], mono: bool) -> str:
    installed = set(QFontDatabase.families())
    general = QFontDatabase.SystemFont.FixedFont if mono else QFontDatabase.SystemFont.GeneralFont
    return next((name for name in wanted if name in installed), QFontDatabase.systemFont(general).family())


def qt_palette(colours: Palette) -> QPalette:
    """The palette as roles of Qt's Fusion style."""
    role = QPalette.ColorRole
    roles = {
        role.Window: colours.panel, role.WindowText: colours.text,
        role.Base: colours.field, role.AlternateBase: colours.panel, role.Text: colours.text,
        role.Button: colours.button, role.ButtonText: colours.text, role.BrightText: colours.bad,
        role.Highlight: colours.accent, role.HighlightedText: colours.on_accent,
        role.ToolTipBase: colours.button, role.ToolTipText: colours.text,
        role.PlaceholderText: colours.muted, role.Link: colours.accent,
        role.Mid: colours.line, role.Dark: colours.line,
    }  # fmt: skip
    palette = QPalette()
    for key, value in roles.items():
        palette.setColor(key, QColor(value))
    for key in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, key, QColor(colours.muted))
    return palette


def style_sheet(theme: Theme) -> str:
    """Style sheet that complements the Fusion style: flat docks, focus ring, tabs and buttons."""
    names = {field.name: getattr(theme.colours, field.name) for field in fields(Palette)}
    sheet = _SHEET
    for name in sorted(names, key=len, reverse=True):
        sheet = sheet.replace(f"@{name};", f"{names[name]};").replace(f"@{name} ", f"{names[name]} ")
    for unit in (2, 4, 6, 8, 12, 16, 24):
        sheet = sheet.replace(f"@{unit}px", f"{theme.pixels(unit)}px")
    return sheet.replace("@arrow", _ARROW.as_posix()).replace("@up", _UP_ARROW.as_posix())


#: Arrows of combo boxes and numbers; Qt's have a frame in a colour outside the palettes.
_ARROW, _UP_ARROW = (Path(__file__).with_name(f"{name}.png") for name in ("down", "up"))
_SHEET = """
QMainWindow, QDialog { background: @window; }
QMainWindow::separator { background: @window; width: 6px; height: 6px; }
QMainWindow::separator:hover { background: @accent; }
QToolTip { background: @button; color: @text; border: 1px solid @line; padding: 4px; }
QMenuBar { background: @window; padding: 2px; }
QMenuBar::item { padding: @4px @8px; background: transparent; border-radius: 4px; }
QMenuBar::item:selected, QMenu::item:selected { background: @accent; color: @on_accent; }
QMenu { background: @panel; border: 1px solid @line; padding: 4px; }
QMenu::item { padding: @4px @24px; border-radius: 4px; }
QMenu::item:disabled { color: @muted; }
QMenu::separator { height: 1px; background: @line; margin: 4px 8px; }
QStatusBar { background: @window; color: @muted; }
QStatusBar::item { border: none; }
QPushButton, QToolButton { background: @button; color: @text; border: 1px solid @line;
    border-radius: 4px; padding: @4px @12px; }
QToolButton { padding: @4px @8px; }
QPushButton:hover, QToolButton:hover { border: 1px solid @accent; }
QPushButton:pressed, QToolButton:pressed, QToolButton:checked, QPushButton:checked
    { background: @accent; color: @on_accent; border: 1px solid @accent; }
QPushButton:disabled, QToolButton:disabled { background: @panel; color: @muted; border: 1px solid @line; }
QPushButton:focus, QToolButton:focus, QLineEdit:focus, QDoubleSpinBox:focus, QComboBox:focus,
QTableView:focus, QPlainTextEdit:focus { border: 1px solid @accent; }
QPushButton#stop { background: @stop; color: @on_stop; border: 1px solid @stop; font-weight: bold; }
QPushButton#stop:disabled { background: @panel; color: @muted; border: 1px solid @line; }
QPushButton#stop:focus, QPushButton#stop:hover { border: 1px solid @on_stop; }
QToolButton#quiet { background: transparent; border: 1px solid transparent; padding: 0 @4px; color: @muted; }
QToolButton#quiet:hover, QToolButton#quiet:focus { border: 1px solid @accent; color: @text; }
QToolButton#quiet:checked { background: @button; color: @text; border: 1px solid @accent; }
QLineEdit, QDoubleSpinBox, QComboBox { background: @field; color: @text; border: 1px solid @line;
    border-radius: 4px; padding: @2px @6px; selection-background-color: @accent;
    selection-color: @on_accent; }
QDoubleSpinBox::up-button, QDoubleSpinBox::down-button { subcontrol-origin: border; width: @16px;
    border-left: 1px solid @line; }
QDoubleSpinBox::up-button { subcontrol-position: top right; }
QDoubleSpinBox::down-button { subcontrol-position: bottom right; }
QDoubleSpinBox::up-button:hover, QDoubleSpinBox::down-button:hover { background: @button; }
QDoubleSpinBox::up-arrow { image: url(@up); width: @12px; height: @12px; }
QDoubleSpinBox::down-arrow { image: url(@arrow); width: @12px; height: @12px; }
QDoubleSpinBox::up-arrow:off, QDoubleSpinBox::down-arrow:off { image: none; }
QLineEdit:disabled, QDoubleSpinBox:disabled, QComboBox:disabled { color: @muted; }
QComboBox::drop-down { border: none; width: @16px; padding-right: @2px; }
QComboBox::down-arrow { image: url(@arrow); width: @12px; height: @12px; }
QComboBox QAbstractItemView { background: @field; color: @text; border: 1px solid @line; }
QCheckBox::indicator { width: @12px; height: @12px; border: 1px solid @muted; border-radius: 3px;
    background: @field; }
QCheckBox::indicator:checked { background: @accent; border: 1px solid @accent; }
QTableView, QPlainTextEdit, QTextBrowser, QListView { background: @field; color: @text;
    border: 1px solid @line; border-radius: 4px; }
QHeaderView::section { background: @panel; color: @muted; border: none; padding: @2px @6px; }
QTabBar { qproperty-drawBase: 0; }
QTabBar::tab { background: @window; color: @muted; padding: @4px @12px; border: none;
    border-bottom: 2px solid transparent; }
QTabBar::tab:selected { color: @text; background: @panel; border-bottom: 2px solid @accent; }
QTabBar::tab:hover { color: @text; }
QTabBar::tab:focus { border: 1px solid @accent; }
QProgressBar { background: @field; color: @text; border: 1px solid @line; border-radius: 4px;
    text-align: center; }
QProgressBar::chunk { background: @simulated; }
QScrollBar { background: transparent; border: none; }
QScrollBar:vertical { width: @12px; }
QScrollBar:horizontal { height: @12px; }
QScrollBar::handle { background: @line; border-radius: 4px; min-height: 24px; min-width: 24px; margin: 2px; }
QScrollBar::add-line, QScrollBar::sub-line { width: 0; height: 0; }
QScrollBar::add-page, QScrollBar::sub-page { background: transparent; }
#panel { background: @panel; }
#header { background: @window; }
#title { background: @panel; border-bottom: 1px solid @line; }
#caption { color: @muted; }
#empty { color: @muted; }
"""
