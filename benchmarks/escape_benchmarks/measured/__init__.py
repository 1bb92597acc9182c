"""Real calibration data: readers of the folders described in their ``README.md``, which the project does not contain."""
