"""Recordings (products and run folders) shown by the panels of a live system.

The panels are in ``panels``; the formats of the files are in ``escape_hw.io``.
"""
