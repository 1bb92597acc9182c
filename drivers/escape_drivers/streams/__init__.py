"""Devices of other real-time computers seen through their shared-memory streams (pyRTC, milk).

Exports ``StreamCamera``, ``StreamMirror``. Stream formats are in ``escape_hw.io.interchange``; ESCAPE's
devices inside pyRTC are in ``escape_drivers.pyrtc_components``.
"""
