"""ALPAO deformable mirrors: the driver and the binding of the vendor's SDK."""

from escape_drivers.alpao.mirror import AlpaoMirror, AlpaoOptions

__all__ = ["AlpaoMirror", "AlpaoOptions"]
