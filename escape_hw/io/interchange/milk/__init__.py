"""Shared-memory images of milk and CACAO, read and written without their library."""
