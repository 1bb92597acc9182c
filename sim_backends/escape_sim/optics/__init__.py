"""Simulated optics and detectors: pupil, Shack-Hartmann and pyramid sensors, focal plane, detector noise.

Models that SPRINT inverts are in ``models``.
"""
