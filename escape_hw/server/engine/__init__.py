"""The process that owns the devices: request handler, procedures, closed loop, streams and published state. Anything that talks to clients directly is in server.frontend."""
