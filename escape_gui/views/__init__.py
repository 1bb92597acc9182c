"""Content of the panels as arrays and text; no Qt. Drawing is in ``widgets``."""
