"""Sweeps over loop parameters and matrices with Optuna: search space, study, workers, analysis.

The closed loop itself is in :mod:`escape_hw.calibration.loop`.
"""
