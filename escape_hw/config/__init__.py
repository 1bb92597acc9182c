"""System files: models of their sections, loading, overrides, renamed keys, and the registry of entry points.

The bundled systems are in ``systems/``. Devices are created in ``escape_hw.bench`` and ``escape_hw.runtime``.
"""
