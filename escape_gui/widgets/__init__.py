"""Reusable widgets: controls, plots, images.

They know nothing of the server; what they show is computed in ``views``, and panels are in ``panels``.
"""
