"""Device interfaces, procedures and result types, on which every other package builds.

Hardware drivers are in ``escape_drivers``, simulated devices in ``escape_sim``, numerics in
``escape_hw.pipeline`` and ``escape_hw.calibration``, files in ``escape_hw.io``.
"""
