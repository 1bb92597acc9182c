"""One module per procedure, from the request to the saved result, and the task protocol that they share.

The algorithms are in ``escape_hw.calibration``.
"""
