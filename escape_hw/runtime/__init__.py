"""What scripts, command line and server run: sessions, procedures, sweeps, device tools, displays.

Numerics are in ``escape_hw.calibration``.
"""
