"""Progress bars for terminals and notebooks."""
