"""Arrays in shared memory: rings, timing, recording.

Streams of other packages (milk, pyRTC) are in :mod:`escape_hw.io.interchange`.
"""
