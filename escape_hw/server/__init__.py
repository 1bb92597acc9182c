"""The server: a front-end process that clients connect to and an engine process that owns the devices. Clients and the messages they exchange with a server are in escape_hw.remote."""
