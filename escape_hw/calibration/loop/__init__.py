"""The closed loop: start-up and frames, live settings, divergence rules, performance, gain search.

The pure controller and reconstructor are in ``escape_hw.pipeline``.
"""
