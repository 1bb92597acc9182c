"""Benchmarks of the real-time pipeline: kernels, loop latency, cost of pokes in a running loop."""
