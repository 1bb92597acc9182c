"""Emulated devices on their own transports (TCP, serial line, USB) with scripted faults.

``escape emulate`` runs them. Vendors' C libraries are simulated in ``stand_ins``.
"""
