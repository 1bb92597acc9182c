"""Simulated deformable mirrors: influence functions, surfaces, flexure, dynamics, the shell.

The devices that use them are in ``devices``, the response of a sensor to them in ``models``.
"""
