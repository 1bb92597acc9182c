"""Recording of streams to disk, and reading of the files.

The rings themselves are in ``escape_hw.streams``.
"""
