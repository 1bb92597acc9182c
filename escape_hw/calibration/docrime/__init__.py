"""DO-CRIME: interaction matrix, temporal response (loop delay) and whitening filter from random pokes.

The numerics are pure; ``acquisition``, ``open_loop`` and ``closed_loop`` move hardware. The mode-by-mode
methods are in ``push_pull``.
"""
