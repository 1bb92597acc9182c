"""PI E-727 controller with a tip-tilt stage.

Transports, GCS protocol, link, controller, circular modulation, driver. Exports ``PiModulator``, ``E727``.
The emulator is in ``escape_sim.emulators``.
"""
