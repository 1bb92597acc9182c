"""Benchmarks that `escape perf` runs, found through the entry points `escape.benchmarks`.

Studies with raw tables are scripts in benchmarks/studies.
"""

from __future__ import annotations
