"""The engine process: devices, loop, procedures, streams, published state. No contact with clients."""
