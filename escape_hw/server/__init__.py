"""The server of a system.

The front end serves the clients, the engine owns the devices, and the fail-safe process flattens the mirror
when the engine dies. The clients' side and the messages are in :mod:`escape_hw.remote`.
"""
