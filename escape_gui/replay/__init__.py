"""Products and run folders, shown by the panels that show a living bench."""
