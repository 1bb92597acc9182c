"""Commands for single devices, emulators and simulated vendor libraries.

The functions that drive the devices are in escape_hw.runtime.host.
"""
