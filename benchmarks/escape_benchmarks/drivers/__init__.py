"""Benchmarks of the device drivers against the least that the vendor's interface allows.

The loop that uses them is measured in ``real_time``.
"""
