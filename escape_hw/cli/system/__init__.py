"""Commands for configurations, server, window, keys, streams, benchmarks, set-up of the computer.

Commands for a single device are in ``cli.devices``.
"""
