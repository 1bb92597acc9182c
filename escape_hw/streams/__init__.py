"""Shared-memory rings of arrays, their readers, timing histograms and the recorder. Streams of other packages (milk, pyRTC) are in escape_hw.io.interchange."""
