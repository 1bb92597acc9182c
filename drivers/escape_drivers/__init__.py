"""Drivers of real hardware, found by the core through the ``escape.devices`` entry points.

No driver is part of this version: bundled systems run on their twins (``mode = "sim"``).
"""
