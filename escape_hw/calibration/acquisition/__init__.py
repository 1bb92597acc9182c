"""Acquisition of frames and slopes, and what every measurement shares.

Set-up of the sensor, poke sequences, telemetry aligned by frame index, checkpoints, previews and the
stopping target. Estimators of interaction matrices are in ``docrime`` and ``push_pull``, the closed loop is
in ``loop``.
"""
