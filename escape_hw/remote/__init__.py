"""Clients of a server: connection, requests, state documents, addresses, keys.

The server is in ``escape_hw.server``.
"""
