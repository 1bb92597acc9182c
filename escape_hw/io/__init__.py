"""Products on disk: FITS files, run folders, documents."""
