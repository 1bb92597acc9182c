"""Science images: frame stack, diffraction image and Strehl ratios.

Measuring the model PSF is in escape_hw.calibration.acquisition.
"""
