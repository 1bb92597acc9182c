"""Interfaces of the devices, of the procedures and of their results."""
