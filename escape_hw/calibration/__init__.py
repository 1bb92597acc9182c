"""The calibration methods: numerics as pure functions, and the procedures that move hardware.

Frame-to-command processing is in ``escape_hw.pipeline``; tasks, files and reports are in
``escape_hw.runtime``, ``escape_hw.io`` and ``escape_hw.report``.
"""
