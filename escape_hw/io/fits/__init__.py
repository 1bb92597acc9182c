"""The FITS products, one module per kind (matrix.

Gains, loop, frames, telemetry, run state), and the checked file format that they share. What a product holds
as a Python object is defined in api/.
"""
