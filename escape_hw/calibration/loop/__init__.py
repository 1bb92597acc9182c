"""The closed loop of the procedures: execution, live settings, divergence rules, performance, gain search.

The pure controller and reconstructor are in ``escape_hw.pipeline``.
"""
