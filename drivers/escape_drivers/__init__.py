"""Drivers of real hardware, found through the entry points ``escape.devices``.

Vendor libraries are loaded when a device is opened. Twins, emulators and stand-ins are in ``escape_sim``.
"""
