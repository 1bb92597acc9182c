"""Calibration files, configuration, geometry and shared-memory streams of pyRTC.

Devices on its streams are in ``escape_drivers.streams``, our devices inside pyRTC in
``escape_drivers.pyrtc_components``.
"""
