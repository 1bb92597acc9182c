"""Data source and requests of the window: session, connection, product library, preconditions. No widgets."""
