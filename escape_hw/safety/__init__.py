"""Limits and the guard that every mirror command passes."""
