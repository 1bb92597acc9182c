"""The open system for scripts and notebooks, and the record of the bench that every product carries.

The procedures that run on it are in ``runtime.procedures``.
"""
