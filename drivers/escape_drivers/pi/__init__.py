"""PI E-727 controller with a tip-tilt stage.

Transports, GCS protocol, link, controller, circular modulation, driver. The emulator is in
``escape_sim.emulators``.
"""

from escape_drivers.pi.controller import E727
from escape_drivers.pi.modulator import PiModulator

__all__ = ["E727", "PiModulator"]
