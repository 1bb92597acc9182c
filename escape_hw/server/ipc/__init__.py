"""Messages between the front end and the engine: framing, start-up settings and log records. Messages between clients and the server are in escape_hw.remote."""
