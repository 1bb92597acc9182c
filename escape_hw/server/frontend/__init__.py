"""The front-end process: clients, lease, transport, supervision of the engine. No numerics, no devices.

``transport`` checks the form of a request, ``front_end`` checks the client's control and forwards the request
to the engine, ``engine_process`` starts and restarts engine and fail-safe process.
"""
