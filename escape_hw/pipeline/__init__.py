"""Pure functions from camera frame to mirror command, and Strehl ratios of science frames.

Procedures that move hardware are in escape_hw.calibration.
"""
