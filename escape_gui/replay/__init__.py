"""Recordings (products and run folders) shown by the panels of a live system."""
