"""Emulators: devices that answer on their own wires."""
