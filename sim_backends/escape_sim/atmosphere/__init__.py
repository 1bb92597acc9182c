"""Simulated turbulence: statistics, drifting and boiling layers, changing seeing, rotating phase plates."""
