"""Buttons, forms, indicators and readouts."""
