"""ALPAO deformable mirrors: the driver and the binding of the vendor's SDK.

Exports ``AlpaoMirror``, ``AlpaoOptions``.
"""
