"""DO-CRIME: interaction matrix and temporal response from random pokes, in open and closed loop.

The modules ``acquisition``, ``open_loop`` and ``closed_loop`` move hardware; the others are pure numerics.
"""
