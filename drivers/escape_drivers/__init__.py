"""Drivers of real hardware, found by the core through the ``escape.devices`` entry points.

Vendor libraries are loaded when a device is opened, never before.
"""
