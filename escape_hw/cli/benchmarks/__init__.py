"""Benchmark stages of the core, found through the entry-point group ``escape.benchmarks``."""
