"""Simulated turbulence: von Karman statistics and screens, drifting and boiling layers, seeing that changes with time, rotating phase plates. The wavefront that a mirror makes is in mirror/."""
