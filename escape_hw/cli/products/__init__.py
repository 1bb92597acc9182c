"""Commands that show, compare, report, export or import files. The formats are in :mod:`escape_hw.io`."""
