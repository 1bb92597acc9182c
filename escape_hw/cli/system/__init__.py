"""Commands for configurations, server, window, keys, streams, benchmarks, set-up of the computer."""
