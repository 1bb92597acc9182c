"""Host computer and single devices: checks, discovery, udev rules, process pools, tools for one device.

The open system with all its devices is in ``runtime.session``.
"""
