"""Dialog to connect to another server: of this computer, at an address, or one that is started here."""

from __future__ import annotations

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import (
    QComboBox,
    QDialog,
    QFileDialog,
    QLabel,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QWidget,
)

from escape_gui.theme import Theme
from escape_gui.widgets.controls import caption, column, row, set_available, text_label
from escape_gui.widgets.inputs import ignore_wheel_without_focus
from escape_hw.config.bundled import bundled_systems
from escape_hw.config.loader import load_system
from escape_hw.errors import EscapeError
from escape_hw.remote import keys
from escape_hw.remote.address import Endpoint, find_server, resolve, running_servers

_ADDRESS = Qt.ItemDataRole.UserRole


class ConnectDialog(QDialog):
    """Chooses a server. The window stays connected to the present one until the choice is valid."""

    #: Name of a system that is served on this computer, or ``tcp://host:port``.
    connect_requested = Signal(str)
    #: Name or file of a system to serve on this computer with simulated devices.
    start_requested = Signal(str)

    def __init__(self, window: QWidget, theme: Theme) -> None:
        super().__init__(window)
        self._theme = theme
        self.setWindowTitle("Connect to a server")
        self.servers = QListWidget()
        self.servers.setAccessibleName("Servers on this computer")
        self.servers.itemSelectionChanged.connect(self._enable)
        self.servers.itemDoubleClicked.connect(lambda _: self._connect_selected())
        self.connect_button, self.refresh_button = QPushButton("Connect"), QPushButton("Refresh")
        self.address, self.server_key = QLineEdit(), QLineEdit()
        self.address.setPlaceholderText("tcp://HOST:PORT")
        self.address.setAccessibleName("Address of a server")
        self.address.textEdited.connect(lambda _: self._enable())
        self.address.returnPressed.connect(self._connect_address)
        self.server_key.setPlaceholderText("public key of that server, once (40 characters)")
        self.server_key.setAccessibleName("Public key of that server")
        self.address_button, self.make_key_button = QPushButton("Connect"), QPushButton("Make a key")
        self.own_key = text_label()
        self.system = QComboBox()
        ignore_wheel_without_focus(self.system)
        self.system.setAccessibleName("System to serve")
        self.system.addItems(bundled_systems())
        self.system.setCurrentText("razor-shwfs")
        self.file_button, self.start_button = QPushButton("File…"), QPushButton("Start here")
        self.start_button.setToolTip("Serve this system with simulated devices, and connect to it.")
        self.message = text_label()
        close = QPushButton("Close")
        for button, handler in (
            (self.connect_button, self._connect_selected), (self.refresh_button, self.refresh),
            (self.address_button, self._connect_address), (self.make_key_button, self._make_key),
            (self.file_button, self._choose_file), (self.start_button, self._start), (close, self.reject),
        ):  # fmt: skip
            button.setAutoDefault(False)
            button.clicked.connect(handler)
        self._headings = [QLabel(text) for text in ("On this computer", "At an address", "Start one here")]
        column(
            self._headings[0], (self.servers, 1), row(self.connect_button, self.refresh_button, None),
            self._headings[1], row((self.address, 1), self.address_button), self.server_key,
            row((self.own_key, 1), self.make_key_button),
            self._headings[2], row((self.system, 1), self.file_button, self.start_button),
            caption("The server goes on when the window connects elsewhere."),
            self.message, row(None, close), parent=self,
        ).setContentsMargins(16, 16, 16, 16)  # fmt: skip
        theme.follow(self._apply_theme)

    def open_list(self) -> None:
        """Show the dialog with the servers that run now."""
        self.message.clear()
        self.refresh()
        self._show_own_key()
        self.show()
        self.raise_()
        self.servers.setFocus()

    def refresh(self) -> None:
        """List the servers of this user on this computer again."""
        self.servers.clear()
        try:
            found = running_servers()
        except EscapeError as error:
            found = ()
            self.show_error(str(error))
        for one in found:
            item = QListWidgetItem(f"{one.system}   process {one.pid}" + (f"   {one.tcp}" if one.tcp else ""))
            item.setData(_ADDRESS, one.system)
            self.servers.addItem(item)
        if found:
            self.servers.setCurrentRow(0)
        else:
            item = QListWidgetItem("none")
            item.setFlags(Qt.ItemFlag.NoItemFlags)
            self.servers.addItem(item)
        self._enable()

    def show_error(self, reason: str) -> None:
        """Show why no connection was made."""
        self.message.setStyleSheet(f"color: {self._theme.colour('bad').name()};")
        self.message.setText(reason)

    def show_progress(self, text: str) -> None:
        """Show what is going on."""
        self.message.setStyleSheet("")
        self.message.setText(text)

    def _enable(self) -> None:
        selected = self.servers.selectedItems()
        set_available(
            self.connect_button, "Connect to the selected server.", "" if selected else "select a server"
        )
        typed = "" if self.address.text().strip() else "type an address"
        set_available(self.address_button, "Connect to this address.", typed)

    # ------------------------------------------------------------ connect
    def _connect_selected(self) -> None:
        if selected := self.servers.selectedItems():
            self._connect(str(selected[0].data(_ADDRESS)))

    def _connect_address(self) -> None:
        address, key = self.address.text().strip(), self.server_key.text().strip()
        try:
            endpoint = resolve(address)
            if key and endpoint.requests.startswith("tcp://"):
                keys.trust(_host(endpoint), key)
                self.server_key.clear()
            keys.client_keys(endpoint.requests)
        except EscapeError as error:
            self.show_error(str(error))
            return
        self._connect(address)

    def _connect(self, address: str) -> None:
        self.show_progress(f"Connecting to {address}…")
        self.connect_requested.emit(address)

    # ------------------------------------------------------------ keys and start
    def _show_own_key(self) -> None:
        try:
            own = keys.own_keys()
        except EscapeError as error:
            self.own_key.setText(str(error))
            return
        self.make_key_button.setVisible(own is None)
        self.own_key.setText(
            "A server on another computer needs a key of this one."
            if own is None
            else f"Key of this computer, to be allowed there with 'escape keys allow':\n{own.public.decode()}"
        )

    def _make_key(self) -> None:
        try:
            keys.make_keys()
        except EscapeError as error:
            self.show_error(str(error))
        self._show_own_key()

    def _choose_file(self) -> None:
        chosen, _ = QFileDialog.getOpenFileName(self, "System to serve", "", "Systems (*.toml)")
        if chosen:
            self.system.insertItem(0, chosen)
            self.system.setCurrentIndex(0)

    def _start(self) -> None:
        system = self.system.currentText()
        try:
            name = load_system(system).system.name
            listing = find_server(name)
        except EscapeError as error:
            self.show_error(str(error))
            return
        if listing is not None and listing.alive:
            self.show_error(f"'{name}' is served already (process {listing.pid}); connect to it above")
            return
        self.show_progress(f"Starting a server of {name}…")
        self.start_requested.emit(system)

    def _apply_theme(self) -> None:
        for heading in self._headings:
            heading.setFont(self._theme.font(bold=True))
        self.own_key.setFont(self._theme.font(0.9))
        self.setMinimumWidth(self._theme.pixels(460))
        self.servers.setMinimumHeight(self._theme.pixels(90))


def _host(endpoint: Endpoint) -> str:
    return endpoint.requests.removeprefix("tcp://").rpartition(":")[0]
