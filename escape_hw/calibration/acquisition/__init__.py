"""Acquisition for all procedures: frames, sensor set-up, pokes, telemetry, checkpoints, previews, targets.

Estimators of interaction matrices are in ``docrime`` and ``push_pull``, the closed loop is in ``loop``.
"""
