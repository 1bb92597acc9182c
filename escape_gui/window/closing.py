"""The question before the window is closed: what runs, and what happens to it."""

from __future__ import annotations

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QMessageBox, QWidget

from escape_hw.remote.state import State


def is_busy(state: State) -> bool:
    """Whether a procedure runs, the loop is closed, or telemetry is recorded."""
    return state.active_run is not None or state.loop.closed or state.recording.recording


def describe_activity(state: State) -> str:
    """What runs, in a sentence."""
    if state.active_run is not None and state.active_run.name == "poke":
        return "A poke is held; it returns to flat by itself."
    if state.active_run is not None:
        return f"'{state.active_run.name}' (run {state.active_run.id}) is running."
    if state.loop.closed:
        return "The loop is closed."
    return "Telemetry is being recorded." if state.recording.recording else "Nothing is running."


def describe_future(state: State, *, mine: bool) -> str:
    """What happens on a server that goes on without this window."""
    run, limit = state.active_run, state.unattended_limit_s
    if state.lease is not None and not mine:
        return f"The server keeps running; {state.lease.name} on {state.lease.host} has control."
    if run is not None and limit:
        what = f"The procedure is aborted after {limit:g} s without an operator, its data are saved"
    elif run is not None:
        what = "The procedure goes on to its end, its result is saved"
    elif state.loop.closed:
        what = "The loop stays closed"
    elif state.recording.recording:
        what = "The recording goes on"
    else:
        what = "The mirror stays flat"
    return (
        f"{what}, and the next window can take control. 'server.unattended_s' of the configuration sets "
        "after which time without an operator a procedure is aborted (0: never)."
    )


class CloseQuestion(QMessageBox):
    """Asks whether to close, and whether a server that the window started is left running."""

    #: Close the window; whether the server is left running.
    answered = Signal(bool)

    def __init__(self, window: QWidget, state: State, *, mine: bool, started_server: bool) -> None:
        super().__init__(window)
        self.setWindowTitle("Close the window?")
        self.setText(describe_activity(state))
        future = describe_future(state, mine=mine)
        role = QMessageBox.ButtonRole
        self.leave_button = self.addButton(
            "Leave the server running" if started_server else "Close the window", role.AcceptRole
        )
        self.leave_button.clicked.connect(lambda: self.answered.emit(True))
        self.stop_button = None
        if started_server:
            future = (
                f"Leave the server running: {future}\n\nStop the server: what runs is aborted, its data are "
                "saved, the mirror is flattened and the devices are closed."
            )
            self.stop_button = self.addButton("Stop the server", role.DestructiveRole)
            self.stop_button.clicked.connect(lambda: self.answered.emit(False))
        self.setInformativeText(future)
        self.cancel_button = self.addButton(QMessageBox.StandardButton.Cancel)
        self.setDefaultButton(self.cancel_button)
        self.setEscapeButton(self.cancel_button)
