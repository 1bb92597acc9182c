"""Shared-memory images of milk and CACAO, read and written without their library.

Devices on such streams are in ``escape_drivers.streams``.
"""
