"""XIMEA cameras: the driver and the binding of the vendor's xiAPI.

Exports ``XimeaCamera``, ``XimeaOptions``.
"""
