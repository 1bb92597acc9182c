"""Limits of mirror commands, and the guard that enforces them on every command.

Supervision of processes (watchdog, fail-safe) is in ``escape_hw.server.safety``.
"""
