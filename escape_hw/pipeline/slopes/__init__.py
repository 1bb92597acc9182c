"""Slopes from camera frames, one module for each kind of sensor.

Finding the sensor's geometry is in escape_hw.pipeline.geometry.
"""
