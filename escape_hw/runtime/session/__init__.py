"""The open system as scripts and notebooks use it, and the record of the bench that every product carries."""
