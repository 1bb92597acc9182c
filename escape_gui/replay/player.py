"""Playback of a recorded run: a slider over its steps and a play button."""

from __future__ import annotations

from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import QLabel, QSlider, QToolBar, QToolButton

from escape_gui.client.session import Session
from escape_gui.replay.source import ReplaySource

#: Number of steps of the slider, and duration of each in playback.
_STEPS, _STEP_MS = 60, 150


class PlaybackBar(QToolBar):
    """Tool bar that is visible while a recorded run with several steps is open."""

    def __init__(self, session: Session) -> None:
        super().__init__("Replay")
        self.setObjectName("transport")
        self.setMovable(False)
        self._session = session
        self._name_label = QLabel()
        self.slider = QSlider(Qt.Orientation.Horizontal)
        self.slider.setRange(0, _STEPS)
        self.slider.setAccessibleName("Position in the recorded run")
        self.slider.setToolTip("Position in the run: iterations, rounds, seconds of tracking.")
        self.slider.valueChanged.connect(self._seek)
        self.play = QToolButton()
        self.play.setText("▶ Play")
        self.play.setCheckable(True)
        self.play.setToolTip("Play the run step by step.")
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
        """The recorded run that is open, if any."""
        source = self._session.source
        return source if isinstance(source, ReplaySource) else None

    def _on_source_changed(self) -> None:
        recording = self.recording
        self.play.setChecked(False)
        self.setVisible(recording is not None and recording.steps > 1)
        if recording is not None:
            self._name_label.setText(f"{recording.path.name}  ")
            self.slider.setValue(_STEPS)

    def _seek(self, value: int) -> None:
        if (recording := self.recording) is not None:
            recording.seek(value / _STEPS)

    def _on_play_toggled(self, on: bool) -> None:
        self.play.setText("⏸ Pause" if on else "▶ Play")
        if on and self.slider.value() == _STEPS:
            self.slider.setValue(0)
        (self._timer.start if on else self._timer.stop)()

    def _step(self) -> None:
        self.slider.setValue(self.slider.value() + 1)
        if self.slider.value() == _STEPS:
            self.play.setChecked(False)
