"""Everything that is read from or written to disk.

FITS products, run folders, JSON documents, provenance, and the formats of other software. Device access is
not here (drivers), live data neither (streams/).
"""
