"""Live data in shared memory, and at full rate on disk."""
