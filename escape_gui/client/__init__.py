"""Where the window's data come from and where its requests go: session, server connection, product library, preconditions of requests. No widgets."""
