"""Emulated adaptive secondary on ESCAPE's TCP link, written from docs/devices/asm-link.md.

It shares no code with the driver, ``escape_drivers.asm``.
"""
