"""Benchmarks that `escape perf` runs, found through the entry points `escape.benchmarks`.

Scripts of the studies are in benchmarks/studies, the command itself in escape_hw/cli/system/perf.py.
"""

from __future__ import annotations
