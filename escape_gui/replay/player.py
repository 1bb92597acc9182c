"""Moves through a recording: a slider over its steps, forward, back, and by itself."""

from __future__ import annotations

from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import QLabel, QSlider, QToolBar, QToolButton

from escape_gui.client.session import Session
from escape_gui.replay.source import ReplaySource

#: A recording plays from beginning to end in so many steps, each this long.
_STEPS, _STEP_MS = 60, 150


class PlaybackBar(QToolBar):
    """Shown while a recording is open that has a course: iterations, rounds, a track."""

    def __init__(self, session: Session) -> None:
        super().__init__("Recording")
        self.setObjectName("transport")
        self.setMovable(False)
        self._session = session
        self._name_label = QLabel("Recording")
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setRange(0, _STEPS)
        self.slider.setAccessibleName("Place in the recording")
        self.slider.setToolTip("How much of the run is shown: iterations, rounds, seconds of tracking.")
        self.slider.valueChanged.connect(self._seek)
        self.play = QToolButton()
        self.play.setText("▶ Play")
        self.play.setCheckable(True)
        self.play.setToolTip("Show how the run went, step by step.")
        self.play.toggled.connect(self._on_play_toggled)
        for widget in (self._name_label, self.play, self.slider):
            self.addWidget(widget)
        self._timer = QTimer(self)
        self._timer.setInterval(_STEP_MS)
        self._timer.timeout.connect(self._step)
        session.changed.connect(self._on_source_changed)
        self._on_source_changed()

    @property
    def recording(self) -> ReplaySource | None:
        """The recording that is open."""
        source = self._session.source
        return source if isinstance(source, ReplaySource) else None

    def _on_source_changed(self) -> None:
        """Another source was taken."""
        found = self.recording
        self.play.setChecked(False)
        self.setVisible(found is not None and found.steps > 1)
        if found is not None:
            self._name_label.setText(f"{found.path.name}  ")
            self.slider.setValue(_STEPS)

    def _seek(self, value: int) -> None:
        if (found := self.recording) is not None:
            found.seek(value / _STEPS)

    def _on_play_toggled(self, on: bool) -> None:
        self.play.setText("⏸ Hold" if on else "▶ Play")
        if on and self.slider.value() == _STEPS:
            self.slider.setValue(0)
        (self._timer.start if on else self._timer.stop)()

    def _step(self) -> None:
        self.slider.setValue(self.slider.value() + 1)
        if self.slider.value() == _STEPS:
            self.play.setChecked(False)
