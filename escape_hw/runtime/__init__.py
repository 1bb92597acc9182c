"""The ``System`` class of scripts.

The procedures shared by command line and server, sweeps, and device tools.

Numerics are in ``escape_hw.calibration``.
"""
