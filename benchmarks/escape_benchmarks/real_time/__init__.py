"""Benchmarks of the real-time pipeline: kernels, loop latency, cost of pokes in a running loop.

The transfer to a single device is in ``drivers``.
"""
