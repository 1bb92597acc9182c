"""Safety of a server: limits on the engine's state, the fail-safe process, the journal.

Limits on single commands are in :mod:`escape_hw.safety`.
"""
