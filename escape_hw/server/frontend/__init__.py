"""The process that clients connect to: ZeroMQ transport, leases, dispatch of requests and supervision of the engine. No numerics and no device access; those are in server.engine."""
