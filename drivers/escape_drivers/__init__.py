"""Drivers of real hardware, found by the core through the ``escape.devices`` entry points.

No driver loads its vendor's library before its device is opened.
"""
