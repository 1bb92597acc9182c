"""The computer and its devices outside of any calibration: environment check, device discovery, udev rules, tools for a single mirror or camera."""
