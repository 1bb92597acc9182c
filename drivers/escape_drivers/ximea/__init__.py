"""XIMEA cameras: the driver and the binding of the vendor's xiAPI."""

from escape_drivers.ximea.camera import XimeaCamera, XimeaOptions

__all__ = ["XimeaCamera", "XimeaOptions"]
