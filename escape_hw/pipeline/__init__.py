"""From camera frame to mirror command: pure functions on arrays."""
