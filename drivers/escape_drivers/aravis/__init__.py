"""GenICam cameras through Aravis: the driver and the binding.

The stand-in of the library is in ``escape_sim.stand_ins``, the base class of cameras in ``common``.
"""

from escape_drivers.aravis.camera import AravisCamera, AravisOptions

__all__ = ["AravisCamera", "AravisOptions"]
