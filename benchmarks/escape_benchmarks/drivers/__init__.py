"""Benchmarks of the device drivers against the least that the vendor's interface allows."""
