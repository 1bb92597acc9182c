"""Messages between the front end and the engine: framing, start-up settings, log records.

Messages between server and clients are in :mod:`escape_hw.remote`.
"""
