"""Commands for configurations, the server, the window, keys, streams, benchmarks and the set-up of the computer."""
