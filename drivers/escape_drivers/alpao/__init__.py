"""ALPAO deformable mirrors: the driver and the binding of the vendor's SDK.

The stand-in of the SDK is in ``escape_sim.stand_ins``, what drivers share in ``common``.
"""

from escape_drivers.alpao.mirror import AlpaoMirror, AlpaoOptions

__all__ = ["AlpaoMirror", "AlpaoOptions"]
