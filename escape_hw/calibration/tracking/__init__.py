"""Tracking of a drifting system in closed loop: live registration, alarms, exchange of the reconstructor.

A single registration fit is in ``sprint``.
"""
