"""The client side of a server: connection, requests, state documents, addresses and keys. The server itself is in escape_hw.server."""
