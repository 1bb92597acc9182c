"""OOPAO as reference: its optics for the twin (`system.optics = "oopao"`) and its synthetic models (`calibration.model = "oopao"`). OOPAO itself is imported on first use only."""
