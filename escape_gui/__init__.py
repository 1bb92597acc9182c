"""The graphical interface, a client of the server, and the only package that imports Qt.

It has no numerics and no device access.
"""
