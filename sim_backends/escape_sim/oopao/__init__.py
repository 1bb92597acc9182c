"""OOPAO as optics of the twin (``system.optics``) and as synthetic model (``calibration.model``).

OOPAO itself is imported on first use.
"""
