"""The calibration engine: pure numerics, and the procedures that move hardware."""
