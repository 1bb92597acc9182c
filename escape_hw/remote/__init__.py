"""Clients of a server: connection, requests, state documents, addresses, keys."""
