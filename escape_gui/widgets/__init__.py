"""Reusable widgets: controls, plots, images."""
