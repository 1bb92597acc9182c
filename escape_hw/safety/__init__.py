"""Limits of mirror commands and the guard that enforces them. Processes that supervise the engine are in escape_hw.server."""
