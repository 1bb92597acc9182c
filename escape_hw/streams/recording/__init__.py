"""Recording of streams to disk and reading the files back."""
