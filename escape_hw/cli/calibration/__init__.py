"""Commands that calibrate, close the loop, track, sweep parameters or reproduce the paper.

Most are derived from the declarations in :mod:`escape_hw.runtime.procedures`.
"""
