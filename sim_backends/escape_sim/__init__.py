"""Simulated twins of the instruments, their optics, and SPRINT's synthetic models."""
