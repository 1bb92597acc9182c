"""Finding lenslets and pupil images on the camera.

Slopes computed on that geometry are in escape_hw.pipeline.slopes.
"""
