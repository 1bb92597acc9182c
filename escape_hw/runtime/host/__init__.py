"""Host computer and single devices: checks, discovery, udev rules, process pools, tools for one device."""
