"""The graphical interface: the only package that may import Qt. A client of the server, and no more."""
