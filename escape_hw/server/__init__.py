"""A server: the front process that speaks to clients, the engine that owns the devices, their guardian."""
