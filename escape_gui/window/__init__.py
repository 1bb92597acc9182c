"""Parts of the main window around the panels: actions, header, docks, notifications, export, help, timer."""
