"""Server that connects the stand-ins of vendor libraries to a simulated bench, for loops with real drivers.

A driver loads a stand-in, which connects to this server over a local socket and sends shapes and fetches
frames, one request and one reply at a time. The simulated time advances when a frame is requested, as for
the simulated devices, however long a driver takes.

Request: kind and length (two uint32), then the payload. Reply: status (0 success, 1 time-out, 2 refused) and
length (two int32), then the payload. All in native byte order.
"""

from __future__ import annotations

import contextlib
import enum
import logging
import shlex
import shutil
import socket
import socketserver
import struct
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from escape_hw.api.camera import Camera, CameraSettings, Region
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.devices import CameraConfig
from escape_hw.config.registry import DeviceContext
from escape_hw.config.toml_text import format_value
from escape_hw.errors import EscapeError, FrameTimeout, SettingRejected
from escape_hw.supervision import BackgroundThread
from escape_sim.devices.twins import make_mirror, make_science_camera, make_wfs_camera, shared_bench
from escape_sim.emulators.e727.emulator import E727Emulator
from escape_sim.stand_ins.library import build_library

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

log = logging.getLogger(__name__)

_REQUEST_HEAD, _REPLY_HEAD = struct.Struct("=II"), struct.Struct("=ii")
_START, _FRAME, _FRAME_HEAD = struct.Struct("=4I3d"), struct.Struct("=d"), struct.Struct("=qq")
_OK, _TIMEOUT, _REFUSED = 0, 1, 2
#: Period in seconds at which the server checks whether it should stop.
_STOP_POLL_S = 0.05
#: Limit for requests, larger than any shape.
_MAX_REQUEST_BYTES = 1 << 20
#: Time-out in seconds of a poll for a frame, too short to advance the simulated time noticeably.
_POLL_S = 1e-6
#: Environment variable by which a driver finds the library of each stand-in.
VARIABLES = {
    "asdk": "ESCAPE_ALPAO_LIBRARY",
    "m3api": "ESCAPE_XIMEA_LIBRARY",
    "aravis": "ESCAPE_ARAVIS_LIBRARY",
}
#: Cameras that the stand-in of Aravis can be, by the size of their sensor; others are a Grasshopper3.
_ARAVIS_PROFILES = {(1604, 1104): "c-blue-one"}
_PROFILE_VARIABLE = "ESCAPE_ARAVIS_PROFILE"
_SOCKET_VARIABLE = "ESCAPE_STAND_IN_BENCH"
#: Environment variable by which the modulator's driver finds the emulated controller.
E727_VARIABLE = "ESCAPE_E727"

Reply = tuple[int, bytes]


class RequestKind(enum.IntEnum):
    """Kinds of request, as in ``stand_in.h``."""

    HELLO = 1
    SEND = 2
    START = 3
    FRAME = 4
    STOP = 5


class StandInBenchServer:
    """The simulated bench of a system behind a local socket; usable as a context manager.

    Parameters
    ----------
    config
        The system; the modes of its devices are ignored.

    Attributes
    ----------
    shared
        Dictionary through which emulators of other devices find the same bench.
    environment
        Environment variables by which drivers find the stand-ins and this bench.
    requests
        Number of requests by kind.
    modulator
        Emulated controller of the modulator, if the system has one.
    """

    def __init__(self, config: SystemConfig) -> None:
        self.config = config
        self.shared: dict[str, object] = {}
        self.environment: dict[str, str] = {}
        self.requests = dict.fromkeys(RequestKind, 0)
        # The bench has one clock; requests of its devices are processed one at a time.
        self._twin_lock = threading.Lock()
        self._server: socketserver.ThreadingUnixStreamServer | None = None
        self._folder: Path | None = None
        self.modulator: E727Emulator | None = None
        self._connections: set[socket.socket] = set()

    def start(self) -> str:
        """Build the bench and listen; returns the socket's path.

        Raises
        ------
        StandInUnavailable
            The stand-ins cannot be compiled on this machine.
        """
        libraries = {variable: str(build_library(name)) for name, variable in VARIABLES.items()}
        shared_bench(self.config, self.shared)
        self._folder = Path(tempfile.mkdtemp(prefix="escape-"))
        path = str(self._folder / "bench")
        self._server = server = socketserver.ThreadingUnixStreamServer(
            path,
            lambda connection, *_: self._serve(connection),  # type: ignore[arg-type]  # called like a class
        )
        self.environment = {
            **libraries,
            _SOCKET_VARIABLE: path,
            **self._aravis_profile(),
            **self._start_modulator_emulator(),
        }
        BackgroundThread("bench", lambda: server.serve_forever(_STOP_POLL_S)).start()
        return path

    def _aravis_profile(self) -> dict[str, str]:
        """Environment variable of the camera that the stand-in of Aravis is."""
        cameras = (self.config.devices.wfs, self.config.devices.science)
        sizes = [one.sensor_px for one in cameras if one is not None and one.driver == "aravis"]
        names = [_ARAVIS_PROFILES[size] for size in sizes if size in _ARAVIS_PROFILES]
        return {_PROFILE_VARIABLE: names[0]} if names else {}

    def _start_modulator_emulator(self) -> dict[str, str]:
        """Start the emulated controller, which moves the simulated beam; returns its environment variable."""
        section = self.config.devices.modulator
        if section is None or section.driver != "pi-e727":
            return {}
        options = {"serial": section.serial, "zeroed": "1"}
        request = EmulatorRequest(port=0, options=options, shared=self.shared, config=self.config)
        self.modulator = E727Emulator(request)
        return {E727_VARIABLE: self.modulator.start().removeprefix("tcp ")}

    def stop(self) -> None:
        """Close all connections and stop listening; may be repeated."""
        if self.modulator is not None:
            self.modulator.stop()
            self.modulator = None
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            for connection in list(self._connections):
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
            server.server_close()
        folder, self._folder = self._folder, None
        if folder is not None:
            shutil.rmtree(folder)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def _serve(self, connection: socket.socket) -> None:
        """Process the requests of one stand-in until it disconnects."""
        handle_request: Callable[[RequestKind, bytes], Reply] = self._refuse_before_hello
        self._connections.add(connection)
        with connection:
            try:
                while (request := _receive(connection)) is not None:
                    kind, payload = request
                    self.requests[kind] += 1
                    if kind is RequestKind.HELLO:
                        status, reply, handle_request = self._select_device(payload)
                    else:
                        with self._twin_lock:
                            status, reply = handle_request(kind, payload)
                    connection.sendall(_REPLY_HEAD.pack(status, len(reply)) + reply)
            except (OSError, ValueError, struct.error) as error:
                log.info("a stand-in disconnected: %s", error)
            finally:
                self._connections.discard(connection)

    def _refuse_before_hello(self, kind: RequestKind, payload: bytes) -> Reply:
        return _REFUSED, b""

    def _select_device(self, payload: bytes) -> tuple[int, bytes, Callable[[RequestKind, bytes], Reply]]:
        """Select the device of a stand-in by kind and serial number, which must be the configured one."""
        kind, _, serial = payload.decode(errors="replace").partition(" ")
        devices = self.config.devices
        if kind == "camera":
            # A GenICam camera, which may be either.
            kind = "wfs" if serial.upper() == devices.wfs.serial.upper() else "science"
        sections = {"mirror": devices.dm, "wfs": devices.wfs, "science": devices.science}
        section = sections.get(kind)
        if section is None or serial.upper() != section.serial.upper():
            known = ", ".join(f"{name} {one.serial!r}" for name, one in sections.items() if one is not None)
            log.warning("no %s with serial number %r on this bench; there are: %s", kind, serial, known)
            return _REFUSED, b"", self._refuse_before_hello
        with self._twin_lock:
            if not isinstance(section, CameraConfig):
                return _OK, struct.pack("=I", devices.dm.n_act), self._open_mirror()
            make = make_wfs_camera if kind == "wfs" else make_science_camera
            camera = make(section, DeviceContext(kind, self.config, self.shared)).open()
            return _OK, struct.pack("=I", camera.info.bit_depth), _CameraEndpoint(camera, section)

    def _open_mirror(self) -> Callable[[RequestKind, bytes], Reply]:
        mirror = make_mirror(self.config.devices.dm, DeviceContext("dm", self.config, self.shared)).open()
        bench = shared_bench(self.config, self.shared)

        def handle_request(kind: RequestKind, payload: bytes) -> Reply:
            if kind is not RequestKind.SEND or len(payload) != 8 * mirror.info.n_act:
                return _REFUSED, b""
            # Without the guard, which is in the driver: electronics accept any shape.
            bench.drive(np.frombuffer(payload))
            return _OK, b""

        return handle_request


class _CameraEndpoint:
    """Handles the requests of a camera's stand-in."""

    def __init__(self, camera: Camera, section: CameraConfig) -> None:
        self._camera, self._section = camera, section

    def __call__(self, kind: RequestKind, payload: bytes) -> Reply:
        try:
            if kind is RequestKind.START:
                return self._start(*_START.unpack(payload))
            if kind is RequestKind.FRAME:
                return self._frame(*_FRAME.unpack(payload))
            if kind is RequestKind.STOP:
                self._camera.stop()
                return _OK, b""
        except FrameTimeout:
            return _TIMEOUT, b""
        except EscapeError as error:
            log.warning("the simulated camera refused a request: %s", error)
        return _REFUSED, b""

    def _start(self, *numbers: float) -> Reply:
        region = Region(*(int(number) for number in numbers[:4]))
        exposure_us, rate_hz, gain_db = numbers[4:]
        self._camera.stop()
        try:
            self._camera.configure(CameraSettings(region, exposure_us * 1e-6, rate_hz, gain_db))
        except SettingRejected as error:
            # With --driver no system file is read, and the default region is the whole sensor.
            log.warning("%s; used with --driver, the camera needs: %s", error, _camera_options(self._section))
            return _REFUSED, b""
        self._camera.start()
        return _OK, b""

    def _frame(self, wait_s: float) -> Reply:
        frame = self._camera.next_frame(max(wait_s, _POLL_S))
        return _OK, _FRAME_HEAD.pack(frame.index, frame.exposed_ns) + frame.data.tobytes()


def _camera_options(section: CameraConfig) -> str:
    """Options of a command with ``--driver`` that read the frames of a section."""
    settings = {"region": list(section.region), **section.options}
    changes = (f"{key}={format_value(value)}" for key, value in settings.items())
    return shlex.join(word for change in changes for word in ("--set", change))


def _receive(connection: socket.socket) -> tuple[RequestKind, bytes] | None:
    """Receive one request; None at the end of the connection, ValueError if it is invalid."""
    head = _receive_exactly(connection, _REQUEST_HEAD.size)
    if head is None:
        return None
    kind, length = _REQUEST_HEAD.unpack(head)
    if length > _MAX_REQUEST_BYTES:
        raise ValueError(f"a request of {length} bytes; the limit is {_MAX_REQUEST_BYTES}")
    payload = _receive_exactly(connection, length)
    return None if payload is None else (RequestKind(kind), payload)


def _receive_exactly(connection: socket.socket, length: int) -> bytes | None:
    parts = bytearray()
    while len(parts) < length:
        part = connection.recv(length - len(parts))
        if not part:
            return None
        parts += part
    return bytes(parts)
