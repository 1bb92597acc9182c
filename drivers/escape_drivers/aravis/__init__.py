"""GenICam cameras through Aravis: the driver and the binding. Exports ``AravisCamera``, ``AravisOptions``."""
