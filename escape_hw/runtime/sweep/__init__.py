"""Sweeps over loop parameters and matrices with Optuna: search space, study, workers, analysis. The closed loop itself is in calibration/loop."""
