"""Benchmarks of the simulated optics against OOPAO. Synthetic models are in ``calibration``."""
