"""System files: models of their sections, reading and overriding, and the registry of entry points. The bundled systems are in systems/."""
