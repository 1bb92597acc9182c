"""Reconstructor, controller and fast matrix products.

The closed loop that runs them is in escape_hw.calibration.loop.
"""
