"""Curves against mode, iteration or time."""
