"""Emulated PI E-727 controller with an S-330 tip-tilt stage (GCS 2.0).

It shares no code with the driver, ``escape_drivers.pi``.
"""
