"""Benchmarks of DO-CRIME, SPRINT and parameter sweeps."""
