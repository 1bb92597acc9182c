"""The engine process: devices, loop, procedures, streams, published state. No contact with clients.

Clients and their control are in ``frontend``, limits on the engine's state in ``safety``.
"""
