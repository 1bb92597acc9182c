"""Emulated adaptive secondary on ESCAPE's TCP link, written from docs/devices/asm-link.md."""
