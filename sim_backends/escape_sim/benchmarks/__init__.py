"""Benchmark stages of the twin, found through the entry-point group ``escape.benchmarks``."""
