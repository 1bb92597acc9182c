"""Thin binding of Aravis (LGPL), which drives GenICam cameras over USB3 Vision and GigE Vision.

Prototypes after the documentation of Aravis 0.8. Functions that may fail take a ``GError **`` last.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any, NamedTuple

from escape_drivers.common.vendor_library import LoadedLibrary, Prototypes
from escape_hw.api.discovery import VendorLibrary
from escape_hw.errors import DeviceError

ARAVIS = VendorLibrary(
    "Aravis library",
    ("libaravis-0.8.so.0", "libaravis-0.8.so"),
    "ESCAPE_ARAVIS_LIBRARY",
    "install it (Debian: apt install libaravis-0.8-0)",
)


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


_ERROR = POINTER(POINTER(_GError))
_INT, _REAL = POINTER(c_int), POINTER(c_double)
_PROTOTYPES: Prototypes = {
    "arv_enable_interface": (None, [c_char_p]),
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (c_uint, []),
    "arv_get_device_id": (c_char_p, [c_uint]),
    "arv_get_device_serial_nbr": (c_char_p, [c_uint]),
    "arv_camera_new": (c_void_p, [c_char_p, _ERROR]),
    "arv_camera_get_model_name": (c_char_p, [c_void_p, _ERROR]),
    "arv_camera_get_sensor_size": (None, [c_void_p, _INT, _INT, _ERROR]),
    "arv_camera_get_width_bounds": (None, [c_void_p, _INT, _INT, _ERROR]),
    "arv_camera_get_height_bounds": (None, [c_void_p, _INT, _INT, _ERROR]),
    "arv_camera_get_width_increment": (c_int, [c_void_p, _ERROR]),
    "arv_camera_get_height_increment": (c_int, [c_void_p, _ERROR]),
    "arv_camera_get_x_offset_increment": (c_int, [c_void_p, _ERROR]),
    "arv_camera_get_y_offset_increment": (c_int, [c_void_p, _ERROR]),
    "arv_camera_set_region": (None, [c_void_p, c_int, c_int, c_int, c_int, _ERROR]),
    "arv_camera_get_region": (None, [c_void_p, _INT, _INT, _INT, _INT, _ERROR]),
    "arv_camera_set_pixel_format_from_string": (None, [c_void_p, c_char_p, _ERROR]),
    "arv_camera_dup_available_pixel_formats_as_strings": (
        POINTER(c_char_p),
        [c_void_p, POINTER(c_uint), _ERROR],
    ),
    "arv_camera_set_frame_rate": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_frame_rate": (c_double, [c_void_p, _ERROR]),
    "arv_camera_get_frame_rate_bounds": (None, [c_void_p, _REAL, _REAL, _ERROR]),
    "arv_camera_set_exposure_time": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_exposure_time": (c_double, [c_void_p, _ERROR]),
    "arv_camera_get_exposure_time_bounds": (None, [c_void_p, _REAL, _REAL, _ERROR]),
    "arv_camera_set_gain": (None, [c_void_p, c_double, _ERROR]),
    "arv_camera_get_gain": (c_double, [c_void_p, _ERROR]),
    "arv_camera_get_gain_bounds": (None, [c_void_p, _REAL, _REAL, _ERROR]),
    "arv_camera_get_payload": (c_uint, [c_void_p, _ERROR]),
    "arv_camera_set_boolean": (None, [c_void_p, c_char_p, c_int, _ERROR]),
    "arv_camera_set_string": (None, [c_void_p, c_char_p, c_char_p, _ERROR]),
    "arv_camera_is_feature_available": (c_int, [c_void_p, c_char_p, _ERROR]),
    "arv_camera_create_stream": (c_void_p, [c_void_p, c_void_p, c_void_p, _ERROR]),
    "arv_camera_start_acquisition": (None, [c_void_p, _ERROR]),
    "arv_camera_stop_acquisition": (None, [c_void_p, _ERROR]),
    "arv_buffer_new_allocate": (c_void_p, [c_size_t]),
    "arv_buffer_get_data": (c_void_p, [c_void_p, POINTER(c_size_t)]),
    "arv_buffer_get_status": (c_int, [c_void_p]),
    "arv_buffer_get_frame_id": (c_uint64, [c_void_p]),
    "arv_buffer_get_timestamp": (c_uint64, [c_void_p]),
    "arv_buffer_get_image_width": (c_int, [c_void_p]),
    "arv_buffer_get_image_height": (c_int, [c_void_p]),
    "arv_stream_push_buffer": (None, [c_void_p, c_void_p]),
    "arv_stream_try_pop_buffer": (c_void_p, [c_void_p]),
    "arv_stream_timeout_pop_buffer": (c_void_p, [c_void_p, c_uint64]),
    "g_object_unref": (None, [c_void_p]),
    "g_free": (None, [c_void_p]),
    "g_error_free": (None, [c_void_p]),
}


class ReceivedBuffer(NamedTuple):
    """A buffer that came from the stream."""

    address: int
    size: int
    status: int
    frame_id: int
    timestamp_ns: int
    width: int
    height: int


class AravisLibrary(LoadedLibrary):
    """The library, loaded, with one camera and at most one stream."""

    VENDOR, PROTOTYPES = ARAVIS, _PROTOTYPES

    def __init__(self, device: str, path: str = "") -> None:
        super().__init__(device, path)
        self.camera: c_void_p | None = None
        self._stream: c_void_p | None = None

    def open(self, serial: str, interface: str = "") -> None:
        """Connect to the camera of a serial number, after enabling an interface (Aravis's own ``"Fake"``)."""
        if interface:
            self.c.arv_enable_interface(interface.encode())
        self.c.arv_update_device_list()
        found = {
            (self.c.arv_get_device_serial_nbr(k) or b"").decode(): self.c.arv_get_device_id(k)
            for k in range(self.c.arv_get_n_devices())
        }
        if serial not in found:
            listing = ", ".join(sorted(found)) or "none at all"
            raise DeviceError(
                self.device,
                f"no camera with serial number {serial!r} (found: {listing}); check cable, serial number and "
                "permissions (udev)",
            )
        self.camera = c_void_p(self.call("camera_new", found[serial], with_camera=False))

    def close(self) -> None:
        """Release the camera after its stream has ended."""
        camera, self.camera = self.camera, None
        if camera is not None:
            self.c.g_object_unref(camera)

    def call(self, name: str, *arguments: Any, with_camera: bool = True) -> Any:
        """Call ``arv_NAME`` with this camera first, if ``with_camera``, and an error pointer last."""
        error = POINTER(_GError)()
        first = (self.camera,) if with_camera else ()
        result = getattr(self.c, f"arv_{name}")(*first, *arguments, byref(error))
        if error:
            message = (error.contents.message or b"").decode(errors="replace")
            self.c.g_error_free(error)
            raise DeviceError(self.device, f"{name}: {message}")
        return result

    def get_ints(self, name: str, n: int) -> list[int]:
        """Several integers from one call."""
        values = [c_int() for _ in range(n)]
        self.call(name, *map(byref, values))
        return [value.value for value in values]

    def get_float_bounds(self, name: str) -> tuple[float, float]:
        """Smallest and largest value of a floating-point feature."""
        low, high = c_double(), c_double()
        self.call(f"camera_get_{name}_bounds", byref(low), byref(high))
        return low.value, high.value

    def first_available(self, names: Sequence[str]) -> str | None:
        """The first of several features that this camera has, or ``None``."""
        for name in names:
            if self.call("camera_is_feature_available", name.encode()):
                return name
        return None

    def set_pixel_format(self, name: str) -> None:
        """Set the pixel format; an unavailable one is refused with those that the camera has."""
        try:
            self.call("camera_set_pixel_format_from_string", name.encode())
        except DeviceError as error:
            available = self._pixel_formats()
            if name in available:
                raise
            raise DeviceError(
                self.device,
                f"has no pixel format '{name}' (there are: {', '.join(available)}); set the option "
                "pixel_format, and bit_depth",
            ) from error

    def _pixel_formats(self) -> list[str]:
        """Names of the pixel formats that the camera has."""
        n = c_uint()
        names = self.call("camera_dup_available_pixel_formats_as_strings", byref(n))
        try:
            return [(names[k] or b"").decode(errors="replace") for k in range(n.value)]
        finally:
            # The strings belong to the camera, the array does not.
            self.c.g_free(names)

    def start_stream(self, n_buffers: int) -> None:
        """Make a stream with its buffers, and start acquisition."""
        payload = self.call("camera_get_payload")
        self._stream = c_void_p(self.call("camera_create_stream", None, None))
        if not self._stream:
            raise DeviceError(
                self.device,
                "Aravis created no stream and gives no reason; is another program using the camera?",
            )
        for _ in range(n_buffers):
            self.c.arv_stream_push_buffer(self._stream, self.c.arv_buffer_new_allocate(payload))
        self.call("camera_start_acquisition")

    def stop_stream(self) -> None:
        """Give the stream and its buffers back."""
        stream, self._stream = self._stream, None
        if stream is not None:
            self.c.g_object_unref(stream)

    def pop_buffer(self, wait_ms: int) -> int | None:
        """A buffer from the stream, or ``None`` when there is none in time."""
        if wait_ms == 0:
            buffer: int | None = self.c.arv_stream_try_pop_buffer(self._stream)
        else:
            buffer = self.c.arv_stream_timeout_pop_buffer(self._stream, wait_ms * 1000)
        return buffer

    def push_buffer(self, buffer: int) -> None:
        """Give a buffer back to the stream."""
        self.c.arv_stream_push_buffer(self._stream, buffer)

    def read_buffer(self, buffer: int) -> ReceivedBuffer:
        """What a buffer holds."""
        c, size = self.c, c_size_t()
        address = c.arv_buffer_get_data(buffer, byref(size))
        return ReceivedBuffer(
            address or 0,
            size.value,
            c.arv_buffer_get_status(buffer),
            c.arv_buffer_get_frame_id(buffer),
            c.arv_buffer_get_timestamp(buffer),
            c.arv_buffer_get_image_width(buffer),
            c.arv_buffer_get_image_height(buffer),
        )
