"""Commands for single devices, emulators and simulated vendor libraries."""
