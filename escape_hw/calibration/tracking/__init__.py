"""Tracking of a drifting system in closed loop: the live registration, alarms, and the exchange of the reconstructor. A single registration fit is in sprint."""
