"""Benchmarks that `escape perf` runs, found through the entry points `escape.benchmarks`.

The command itself is in escape_hw/cli/system/perf.py. Scripts of the studies are in benchmarks/studies;
``realisation_tables``, ``matrix_agreement`` and ``measured`` are for them.
"""

from __future__ import annotations
