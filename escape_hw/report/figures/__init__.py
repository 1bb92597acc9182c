"""Matplotlib figures, one module per subject.

They take results or JSON documents and return figures; they write no files.
"""
