"""Simulated deformable mirrors: influence functions, surfaces under a registration, flexure, actuator dynamics, the shell of an adaptive secondary. Device classes are in devices/."""
