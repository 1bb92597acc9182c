"""GenICam cameras through Aravis: the driver and the binding."""

from escape_drivers.aravis.camera import AravisCamera, AravisOptions

__all__ = ["AravisCamera", "AravisOptions"]
