"""What several drivers share.

Loading of vendor libraries, parsing of options, base class and limits of cameras.
"""
