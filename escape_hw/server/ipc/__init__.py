"""Messages between the front end and the engine: framing, start-up settings, log records."""
