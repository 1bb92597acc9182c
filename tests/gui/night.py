"""A night of operation: an operator works through it in the window, with clicks and keys, on a server.

``python night.py run FOLDER SYSTEM [FRAMES [STEP ...]]`` serves the system, works through the whole night,
or some of its steps, and leaves images of the window in ``FOLDER/screenshots``. ``python night.py step NAME
SYSTEM`` joins a server that runs, and repeats one step of the night until it is killed. Lines on standard
output say what is under way.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, date, datetime, timedelta
from html import escape
from pathlib import Path

import numpy as np
import serving
from gui_windows import click_pixel
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDialogButtonBox, QPushButton, QWidget
from whole_run import Operator, operating, operator_window

from escape_gui.app import qt_application
from escape_gui.main_window import MainWindow
from escape_gui.panels.loop import LoopPanel
from escape_gui.panels.mirror import COMMAND, MirrorPanel
from escape_gui.panels.night import NightPanel
from escape_gui.widgets.controls import HOLD_MS
from escape_gui.widgets.inputs import NumberBox
from escape_hw.io.run_folder import find_runs, read_result
from escape_hw.remote.state import Finish, FinishedRun, Phase

#: Sizes and themes in which the window is looked at.
SIZES = ((1024, 700), (1280, 760), (1600, 960), (2560, 1400))
THEMES = ("dark", "light")


class Night:
    """The steps of a night; each leaves the bench ready for the next.

    Parameters
    ----------
    operator
        In front of a window that is connected.
    folder
        For images and what is exported; no images are saved without it.
    frames
        Frames of a calibration.
    """

    def __init__(self, operator: Operator, folder: Path | None = None, frames: int = 2000) -> None:
        self.operator, self.folder, self.frames = operator, folder, frames
        self.window = operator.window
        loop, mirror, log = (self.window.panels[name] for name in ("loop", "mirror", "night"))
        assert isinstance(loop, LoopPanel)
        assert isinstance(mirror, MirrorPanel)
        assert isinstance(log, NightPanel)
        self.loop, self.mirror, self.log = loop, mirror, log
        #: What the log of the night must contain, in HTML.
        self.events = ["server started"]

    @property
    def state(self):
        """The newest state of the server."""
        return self.window.context.session.source.state

    # ------------------------------------------------------------ start
    def start(self) -> None:
        """Connect and take control with a key."""
        self.operator.until(lambda: self.state.phase in (Phase.IDLE, Phase.LOOP, Phase.FAULT), "it is ready")
        session = self.window.context.session
        if not session.may_write:
            self.key(Qt.Key.Key_L, Qt.KeyboardModifier.ControlModifier)
            self.operator.until(lambda: session.may_write, "we have control")
        self.operator.until(lambda: not self.window.control_banner.isVisible(), "nothing is offered")

    def ready(self) -> None:
        """Whatever was before: control, no fault, an open loop, and a matrix."""
        self.operator.until(lambda: self.state.phase is not Phase.STARTING, "the engine has started")
        self.start()
        self.key(Qt.Key.Key_2, Qt.KeyboardModifier.ControlModifier)
        if self.state.recording.recording:
            self.key(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
            self.operator.until(lambda: not self.state.recording.recording, "the recording has ended")
        if self.state.active_run is not None:
            self.operator.until(lambda: self.operator.procedure.abort.isEnabled(), "the run can be stopped")
            self.operator.press(self.operator.procedure.abort)
            self.operator.until(lambda: self.state.active_run is None, "the run has ended")
        if self.state.loop.closed:
            self.operator.press(self.window.header.open_button)
            self.operator.until(lambda: not self.state.loop.closed, "the loop is open")
        if self.state.fault is not None:
            self.clear_fault()
        self.operator.until(lambda: self.state.phase is Phase.IDLE, "the engine is idle")
        self.operator.until(lambda: self.operator.procedure._state.phase is Phase.IDLE, "the panel knows")

    # ------------------------------------------------------------ the night
    def align(self) -> None:
        """Find the sub-apertures, and look at the light."""
        self.run("sensor")
        assert "Sub-apertures:" in self.operator.procedure.numbers.text()
        self.key(Qt.Key.Key_1, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: self.state.illumination.peak > 0, "light on the sensor")
        self.images("align")

    def calibrate(self) -> None:
        """ESCAPE, with its verdict and its numbers."""
        ended = self.run("escape", frames=str(self.frames))
        panel = self.operator.procedure
        assert panel.verdict.text().split(":")[0] in ("Good", "Usable"), panel.verdict.text()
        assert "Shift x" in panel.numbers.text()
        assert (Path(ended.folder) / "result.json").is_file()
        modes = self.window.panels["modes"]
        self.operator.until(lambda: modes.matrix_selector.currentText() == "ESCAPE", "the matrix is shown")
        self.images("calibrate")

    def close(self) -> None:
        """Close the loop with the newest matrix."""
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        self.ensure_matrix()
        self.hold_to_close()
        self.operator.until(lambda: "Loop closed with" in self.loop.message.text(), "the result is told")
        self.operator.until(lambda: self.state.loop.residual_nm > 0, "the residual is measured")

    def gain(self) -> None:
        """Type another gain into the closed loop, check and apply it."""
        self.ensure_closed()
        goal = 0.35 if abs(self.state.loop.gain - 0.35) > 1e-6 else 0.3
        flattened = self.state.mirror.flatten_count
        self.type(self.loop.gain, str(goal))
        assert self.loop.gain.text().startswith(str(goal))
        QTest.keyClick(self.loop.gain, Qt.Key.Key_Return)
        assert self.loop.message.text().startswith("Checked: gain"), self.loop.message.text()
        self.operator.until(self.loop.apply_button.isEnabled, "it can be applied")
        self.operator.press(self.loop.apply_button)
        self.operator.until(lambda: abs(self.state.loop.gain - goal) < 1e-6, "the gain has changed")
        self.operator.until(lambda: "Applied" in self.loop.message.text(), "the result is told")
        assert self.state.loop.closed
        assert self.state.mirror.flatten_count == flattened, "the loop has gone on"
        self.images("operate")

    def poke(self) -> None:
        """Poke every mode in closed loop (DO-CRIME); the loop is closed again afterwards."""
        self.ensure_closed()
        matrix = self.state.loop.matrix
        self.run("docrime", frames=str(self.frames), closed_loop=matrix)
        assert self.operator.procedure.verdict.text()
        self.operator.until(lambda: self.state.loop.closed, "the loop is closed again")
        assert self.state.loop.matrix == matrix

    def poke_actuator(self) -> None:
        """Click an actuator in the map and poke it with the button; then the mirror is flat again."""
        if self.state.loop.closed:
            self.open()
        self.key(Qt.Key.Key_1, Qt.KeyboardModifier.ControlModifier)
        mirror, source = self.mirror, self.window.context.session.source
        self.operator.until(mirror.arm_button.isEnabled, mirror.arm_button.toolTip())
        self.operator.press(mirror.arm_button)
        self.operator.until(lambda: mirror.image_view.data is not None, "the map is shown")
        self.operator.settle(0.3)
        numbers = mirror._map.numbers
        y, x = (int(size) // 2 for size in numbers.shape)
        click_pixel(mirror.image_view, x, y)
        number = int(numbers[y, x])
        assert mirror.poke_number.value() == number
        assert mirror.poke_kind.selected == "actuator"
        self.operator.until(
            lambda: f"actuator {number} at +0.05" in mirror.poke_text.text(), mirror.poke_text.text()
        )
        flat = np.zeros(int(numbers.max()) + 1)
        poked = np.where(np.arange(flat.size) == number, mirror.poke_amplitude.value(), flat)

        def commands() -> np.ndarray:
            sample = source.latest("commands")
            return np.full(1, np.nan) if sample is None else sample.data

        self.hold(mirror.poke_button)
        self.operator.until(lambda: np.allclose(commands(), poked, atol=1e-6), "the actuator is poked")
        self.operator.until(lambda: np.allclose(mirror._values[COMMAND], poked, atol=1e-6), "it is shown")
        self.operator.until(lambda: self.state.active_run is None, "the poke ends by itself")
        self.operator.until(lambda: np.allclose(commands(), flat, atol=1e-6), "the mirror is flat")
        self.operator.until(lambda: self.state.mirror.peak < 1e-6, "the server says so")
        self.operator.until(lambda: "flat again" in mirror.poke_text.text(), "the panel says so")
        self.events.append(f"poke of actuator {number} at +0.05 of the stroke")
        self.images("poke")
        self.operator.press(mirror.arm_button)
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)

    def record(self) -> None:
        """Record telemetry; the number of frames grows in the last line."""
        self.ensure_closed()
        self.key(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: self.state.recording.written > 200, "frames are recorded")
        label = self.window._status_labels["recording"]
        self.operator.until(lambda: label.text().startswith("recording"), "the growth is visible")
        path = self.state.recording.path
        self.key(Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: not self.state.recording.recording, "the recording has ended")
        assert list(Path(path).parent.glob(f"{Path(path).name}*")), path
        self.window.docks["telemetry"].raise_()
        self.images("record")
        self.window.docks["performance"].raise_()

    def crash(self) -> None:
        """The engine dies: the window says so and offers the remedy; then everything works again."""
        self.ensure_closed()
        times = self.window.context.session.history.residual.arrays[0].size
        os.kill(self.state.engine_pid, signal.SIGKILL)
        self.operator.until(lambda: self.state.fault is not None, "the fault is latched")
        self.operator.until(self.window.fault_banner.isVisible, "the fault is shown")
        self.operator.until(lambda: self.window.header.phase.text == "fault", "the header says so")
        assert not self.state.loop.closed
        assert not self.loop.close_button.isEnabled()
        assert self.loop.close_button.toolTip()
        assert self.window.context.session.history.residual.arrays[0].size >= times, "the history stays"
        self.images("crash")
        self.events += [
            f"FAULT: {escape(self.state.fault.reason)}",
            "fault cleared",
        ]
        self.clear_fault()
        self.operator.until(lambda: not self.window.fault_banner.isVisible(), "the fault is gone")
        self.operator.until(
            lambda: (
                "Fault, mirror made safe"
                not in [one.title for one in self.window.notifications.notifications]
            ),
            "its message is gone",
        )

    def take_over(self) -> None:
        """A second window takes control, closes, and the first one takes it back with its button."""
        if self.state.loop.closed:
            self.open()
        self.key(Qt.Key.Key_2, Qt.KeyboardModifier.ControlModifier)
        banner = self.window.control_banner
        with operator_window(self.state.system, workspace="operate") as second:
            other = second.window
            second.until(lambda: other.context.session.source.state.phase is Phase.IDLE, "it is connected")
            assert not other.context.session.may_write
            second.until(lambda: "has control" in other.header.control.text, "it says who has control")
            self.key(Qt.Key.Key_L, Qt.KeyboardModifier.ControlModifier, other)
            second.until(lambda: other.context.session.may_write, "it has control")
            self.operator.until(lambda: "has control" in self.window.header.control.text, "the first is told")
            self.operator.until(lambda: not self.operator.procedure.start.isEnabled(), "it cannot start")
            other.close()
            second.until(lambda: not other.isVisible(), "it closes without a question")
        self.operator.until(banner.isVisible, "control is offered")
        assert "No operator has control" in banner.text.text()
        self.operator.press(banner.button)
        self.operator.until(lambda: self.window.context.session.may_write, "we have control again")

    def reload(self) -> None:
        """Load the matrix of the night before from the list of runs, and close the loop with it."""
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        if self.state.loop.closed:
            self.open()
        yesterday = self.copy_to_yesterday()
        browser = self.window.run_browser
        self.key(Qt.Key.Key_M, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: browser.isVisible() and browser.table.rowCount() > 1, "runs are listed")
        QTest.keyClicks(browser.filter, yesterday.isoformat())
        visible = [k for k in range(browser.table.rowCount()) if not browser.table.isRowHidden(k)]
        assert len(visible) == 1, visible
        item = browser.table.item(visible[0], 0)
        assert item is not None
        where = browser.table.visualItemRect(item).center()
        QTest.mouseClick(browser.table.viewport(), Qt.MouseButton.LeftButton, pos=where)
        assert browser.selected is not None
        assert browser.selected.date.startswith(yesterday.isoformat())
        assert browser.message.text() == browser.selected.verdict
        before = len(self.state.products)
        self.operator.press(browser.load_button)
        self.operator.until(lambda: browser.message.text().startswith("Loaded as"), browser.message.text)
        self.images("runs", browser)
        browser.reject()
        assert len(self.state.products) > before
        name = self.state.products[-1].name
        self.operator.until(lambda: self.loop.matrix.currentText() == name, "the matrix is the setpoint")
        self.operator.press(self.loop.check_button)
        self.hold_to_close()
        assert self.state.loop.matrix == name

    def alarm(self) -> None:
        """Type a limit that the loop exceeds; the alarm is visible until it is acknowledged."""
        self.ensure_closed()
        self.window.actions_by_name["alarms"].trigger()
        dialog = self.window.alarm_dialog
        self.type(dialog.limits["residual"], "1")
        dialog.muted.setChecked(True)
        buttons = dialog.findChild(QDialogButtonBox)
        assert buttons is not None
        self.operator.press(buttons.button(QDialogButtonBox.StandardButton.Ok))
        banner = self.window.alarm_banner
        self.operator.until(banner.isVisible, "the alarm is shown")
        assert "Residual" in banner.text.text()
        self.events += ["ALARM: Residual", "above 1 nm rms"]
        self.images("alarm")
        self.key(Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: not banner.isVisible(), "it is acknowledged")
        self.window._settings.alarms.clear()

    def export_log(self) -> None:
        """Write a note into the log of the night, and export it as a page with figures."""
        if self.state.loop.closed:
            self.open()
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        note = "clouds from the west, <seeing> worse"
        self.log.note.setFocus()
        QTest.keyClicks(self.log.note, note)
        QTest.keyClick(self.log.note, Qt.Key.Key_Return)
        self.operator.until(lambda: note in self.log.text.toPlainText(), "the note is listed")
        self.operator.until(lambda: not self.log.note.text(), "the field is cleared")
        self.images("night_log")
        with tempfile.TemporaryDirectory() as temporary:
            page = (self.folder or Path(temporary)) / "night.html"
            self.log.export_to(page)
            self.operator.until(
                lambda: self.log.message.text().startswith(("Written", "Not written")), "it is exported"
            )
            assert self.log.message.text() == f"Written: {page}"
            content = page.read_text()
        assert escape(note) in content
        assert "<svg" in content, "figures"
        for event in self.events:
            assert event in content, f"{event} is not in the log:\n{self.log.text.toPlainText()}"

    # ------------------------------------------------------------ parts of steps
    def key(
        self, key: Qt.Key, modifier: Qt.KeyboardModifier = Qt.KeyboardModifier.NoModifier,
        window: MainWindow | None = None,
    ) -> None:  # fmt: skip
        """Press a shortcut in a window, which must be the active one."""
        window = window or self.window
        window.setFocus()
        for _ in range(20):
            # A display without a window manager may ignore the first request.
            window.raise_()
            window.activateWindow()
            self.operator.settle(0.1)
            if window.isActiveWindow():
                break
        else:
            QApplication.setActiveWindow(window)
        QTest.keyClick(window, key, modifier)

    def type(self, field: NumberBox, text: str) -> None:
        """Type a number into a field, key by key, while the states of the server arrive."""
        field.setFocus()
        field.selectAll()
        for letter in text:
            QTest.keyClicks(field, letter)
            self.operator.settle(0.1)

    def hold(self, button: QPushButton) -> None:
        """Hold a button down until it acts."""
        self.operator.until(button.isEnabled, f"{button.text()}: {button.toolTip()}")
        QTest.mousePress(button, Qt.MouseButton.LeftButton)
        self.operator.settle(HOLD_MS / 1000 + 0.3)
        QTest.mouseRelease(button, Qt.MouseButton.LeftButton)

    def run(self, name: str, **arguments: str) -> FinishedRun:
        """Run a procedure with the form of the workspace for calibrations."""
        self.key(Qt.Key.Key_2, Qt.KeyboardModifier.ControlModifier)
        ended = self.operator.run(name, **arguments)
        assert ended.finish is Finish.DONE, ended.message
        folder = f" [{Path(ended.folder).name}]" if ended.folder else ""
        self.events += [f"run {ended.id}, {name}: started", f"run {ended.id}, {name}: done{folder}"]
        return ended

    def hold_to_close(self) -> None:
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        self.hold(self.loop.close_button)
        self.operator.until(lambda: self.state.loop.closed, "the loop is closed")
        self.events.append(escape(f"loop closed on '{self.state.loop.matrix}', gain"))

    def open(self) -> None:
        """Open the loop with the button that is always visible."""
        self.operator.press(self.window.header.open_button)
        self.operator.until(lambda: not self.state.loop.closed, "the loop is open")
        self.operator.until(lambda: self.state.phase is Phase.IDLE, "the engine is idle")
        self.events.append("loop opened")

    def clear_fault(self) -> None:
        button = self.window.fault_banner.button
        self.operator.until(button.isVisible, "the fault is shown")
        self.hold(button)
        self.operator.until(lambda: self.state.fault is None, "the fault is cleared")
        self.operator.until(lambda: self.state.phase is Phase.IDLE, "a new engine is idle")

    def ensure_matrix(self) -> None:
        """A matrix in the server, from the list of runs or measured now."""
        if not any(one.kind == "matrix" for one in self.state.products):
            self.run("docrime", frames=str(self.frames))
            self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        self.operator.until(lambda: self.loop.matrix.count() > 0, "a matrix is offered")

    def ensure_closed(self) -> None:
        self.key(Qt.Key.Key_3, Qt.KeyboardModifier.ControlModifier)
        if not self.state.loop.closed:
            self.ensure_matrix()
            self.hold_to_close()

    def copy_to_yesterday(self) -> date:
        """Put a run with a matrix into the folder of the day before; the day."""
        runs = Path(self.state.disk.folder)
        day = datetime.now(UTC).astimezone().date() - timedelta(days=1)
        for folder in find_runs(runs):
            if (folder / "result.json").is_file() and "im" in read_result(folder)["products"]:
                target = runs / day.isoformat() / folder.name
                if not target.exists():
                    # Whole or not at all, even if this process is killed meanwhile.
                    copy = shutil.copytree(folder, Path(tempfile.mkdtemp(dir=runs)) / folder.name)
                    target.parent.mkdir(exist_ok=True)
                    copy.rename(target)
                return day
        raise AssertionError("no run with a matrix")

    # ------------------------------------------------------------ what is seen
    def images(self, name: str, dialog: QWidget | None = None) -> None:
        """Look at the window in all sizes and both themes: buttons and messages are inside; save images."""
        if self.folder is None:
            return
        (self.folder / "screenshots").mkdir(exist_ok=True)
        theme, size, began = (
            self.window.context.theme,
            self.window.size(),
            self.window.context.theme.palette_name,
        )
        for width, height in SIZES:
            self.resize(width, height)
            for palette in THEMES:
                theme.set_palette(palette)
                self.operator.settle(0.4)
                at = f"{name} at {width} x {height}"
                assert (self.window.width(), self.window.height()) == (width, height), (
                    f"{at}: {self.window.size()}, at least {self.window.minimumSizeHint()}"
                )
                header = self.window.header
                for widget in (header.open_button, header.flatten_button, self.window.statusBar()):
                    place = QRect(widget.mapTo(self.window, QPoint(0, 0)), widget.size())
                    assert widget.isVisible(), at
                    assert self.window.rect().contains(place), f"{at}: {place}"
                path = self.folder / "screenshots" / f"{name}-{width}-{palette}.png"
                assert (dialog or self.window).grab().save(str(path))
        theme.set_palette(began)
        self.resize(size.width(), size.height())

    def resize(self, width: int, height: int) -> None:
        """Resize the window, again if a display server was in the middle of something."""
        for _ in range(5):
            self.window.resize(width, height)
            self.operator.settle(0.3)
            if (self.window.width(), self.window.height()) == (width, height):
                return

    def seen(self) -> dict[str, object]:
        """What a window that has just been opened tells the operator."""
        header, state = self.window.header, self.state
        notes = [f"{one.title}: {one.text}" for one in self.window.notifications.notifications]
        banners = [
            banner.text.text()
            for banner in (self.window.fault_banner, self.window.control_banner)
            if banner.isVisible()
        ]
        return {
            "banners": banners, "notifications": notes, "phase": header.phase.text,
            "loop": header.loop.text, "run": "" if state.active_run is None else state.active_run.name,
            "outcome": self.operator.procedure.outcome.text(),
        }  # fmt: skip


#: The night, in its order; the first one connects.
STEPS = (
    "start", "align", "calibrate", "close", "gain", "poke", "poke_actuator", "record", "crash", "take_over",
    "reload", "alarm", "export_log",
)  # fmt: skip


def say(word: str, **content: object) -> None:
    """Tell the process that waits."""
    print(json.dumps({"what": word, **content}), flush=True)


@contextmanager
def application() -> Iterator[None]:
    app = qt_application()
    try:
        yield
    finally:
        app.processEvents()


def run_night(folder: Path, system: str, frames: int, steps: Sequence[str]) -> None:
    """The night, or some of its steps, on a server of its own."""
    with operating(system, folder, workspace="align") as operator:
        night = Night(operator, folder, frames)
        for name in steps or STEPS:
            began = time.monotonic()
            getattr(night, name)()
            say("done", step=name, seconds=round(time.monotonic() - began, 1))


def repeat_step(name: str, system: str, frames: int) -> None:
    """Say what is seen, then one step again and again, until killed."""
    with operator_window(system, workspace="operate") as operator:
        night = Night(operator, frames=frames)
        operator.until(lambda: night.state.server_pid != 0, "connected")
        operator.settle(1.5)
        say("seen", **night.seen())
        night.ready()
        while name:
            say("begin", step=name)
            getattr(night, name)()
            say("done", step=name)
            if night.state.loop.closed:
                night.open()


if __name__ == "__main__":
    mode, first, system_name, *more = sys.argv[1:]
    n_frames = int(more[0]) if more else 2000
    with application():
        if mode == "run":
            run_night(Path(first), system_name, n_frames, more[1:])
        else:
            serving.SYSTEM = system_name
            repeat_step("" if first == "none" else first, system_name, n_frames)
