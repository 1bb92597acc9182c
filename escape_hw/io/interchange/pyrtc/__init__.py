"""Calibration files, configuration, geometry and shared-memory streams of pyRTC."""
