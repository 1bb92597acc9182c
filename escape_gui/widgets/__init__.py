"""Widgets that several panels use; none knows what it shows."""
