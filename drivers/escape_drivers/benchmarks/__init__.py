"""What the drivers cost."""
