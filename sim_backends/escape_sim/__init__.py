"""Simulated devices, their optics, synthetic models, emulators and stand-ins of vendors' libraries.

Imports ``escape_hw`` only and is loaded through entry points.
"""
