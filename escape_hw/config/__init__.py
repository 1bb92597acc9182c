"""Configuration of systems: models, files, overrides and the registry of drivers and twins."""
