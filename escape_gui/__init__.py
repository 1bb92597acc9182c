"""The graphical interface: the only package that may import Qt.

No window is part of this version; the command line and scripts do everything.
"""
