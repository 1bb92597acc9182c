"""The front-end process: clients, lease, transport, supervision of the engine. No numerics, no devices."""
