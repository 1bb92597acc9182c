"""Files and streams of other adaptive-optics software, read and written.

Other packages are imported when they are needed, never before; the extra ``interchange`` brings them.
"""
