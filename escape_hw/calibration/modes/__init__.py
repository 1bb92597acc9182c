"""Modal bases as mode-to-command matrices, and matrices and derivatives of synthetic models by mode.

Anything that takes frames or moves a mirror is in ``acquisition`` and above.
"""
