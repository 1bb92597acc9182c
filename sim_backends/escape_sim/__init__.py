"""Twins of every device, their optics, and the synthetic models that SPRINT inverts."""
