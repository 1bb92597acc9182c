"""FITS products, one module per kind, and the checked file format that they share.

Kinds: matrix, gains, loop, frames, telemetry, run state. The Python objects are defined in ``escape_hw.api``.
"""
