"""Parts of the main window around the panels: actions, header, docks, notifications, export, help, timer.

The panels are in ``panels``, the connection to the server in ``client``.
"""
