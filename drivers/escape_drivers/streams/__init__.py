"""Devices of other real-time computers seen through their shared-memory streams (pyRTC, milk).

Stream formats are in ``escape_hw.io.interchange``; ESCAPE's devices inside pyRTC are in
``escape_drivers.pyrtc_components``.
"""

from escape_drivers.streams.camera import MilkCamera, PyrtcCamera
from escape_drivers.streams.mirror import MilkMirror, PyrtcMirror

__all__ = ["MilkCamera", "MilkMirror", "PyrtcCamera", "PyrtcMirror"]
