"""Benchmarks of the simulated optics against OOPAO."""
