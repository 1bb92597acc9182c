"""Drivers of real hardware.

A driver is a class that can be used alone, ``AlpaoMirror(serial="BAX118")``, or in a system, which finds it
through the entry points ``escape.devices``. Vendor libraries are loaded when a device is opened. Twins,
emulators and stand-ins are in ``escape_sim``.
"""
