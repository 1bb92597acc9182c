"""Parts of the main window around the panels: actions, header, docks, workspaces, notifications, export, help, update timer."""
