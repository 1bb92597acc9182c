"""The simulated bench (one clock, one beam, the true state) and the simulated devices on it.

What they compute is in ``optics``, ``mirror`` and ``atmosphere``.
"""
