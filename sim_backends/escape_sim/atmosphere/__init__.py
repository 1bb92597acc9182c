"""Simulated turbulence: statistics, drifting and boiling layers, changing seeing, rotating phase plates.

The propagation to a sensor is in ``optics``.
"""
