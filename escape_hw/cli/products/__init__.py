"""Commands that show, compare, report, export or import files. The file formats are in escape_hw.io."""
