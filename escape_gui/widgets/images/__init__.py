"""Images, maps and colour scales."""
