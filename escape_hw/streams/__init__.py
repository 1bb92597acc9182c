"""Arrays in shared memory: rings, their camera, timing, recording.

Streams of other packages (milk, pyRTC) are in :mod:`escape_hw.io.interchange`.
"""
