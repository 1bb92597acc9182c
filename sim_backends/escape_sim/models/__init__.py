"""Fast synthetic models of the sensors' response to the mirror, as inverted by SPRINT.

They read the configuration and what a sensor measures, never the twin's true state.
"""
