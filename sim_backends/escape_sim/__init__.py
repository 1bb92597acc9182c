"""Simulated devices (twins), their optics, the synthetic models that SPRINT inverts, emulators and stand-ins of vendor libraries. Imports escape_hw only; loaded through entry points."""
