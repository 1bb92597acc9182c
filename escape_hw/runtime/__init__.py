"""What runs on an open system: the System class of scripts, the procedures that command line and server share, sweeps, and tools for the computer and single devices. Numerics are in calibration/."""
