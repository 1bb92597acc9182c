"""Benchmarks of the drivers."""
