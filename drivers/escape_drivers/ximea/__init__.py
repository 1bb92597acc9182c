"""XIMEA cameras: the driver and the binding of the vendor's xiAPI.

The stand-in of xiAPI is in ``escape_sim.stand_ins``, the base class of cameras in ``common``.
"""

from escape_drivers.ximea.camera import XimeaCamera, XimeaOptions

__all__ = ["XimeaCamera", "XimeaOptions"]
