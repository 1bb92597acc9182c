"""Optical gains of the modes.

From the top: the bootstrap that closes the loop with a matrix of unknown scale, its first closure, estimation
from pokes in closed loop, smoothing over the modes, and comparison of two matrices. The loop is in ``loop``.
"""
