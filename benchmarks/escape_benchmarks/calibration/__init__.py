"""Benchmarks of DO-CRIME, SPRINT and parameter sweeps. The packages compared with are in ``peers``."""
