"""Adaptive secondary mirror behind a TCP link: messages, codec, link, driver, observer.

The emulator is in ``escape_sim.emulators``.
"""

from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.mirror import AsmMirror
from escape_drivers.asm.observer import AsmObserver
from escape_drivers.asm.options import AsmOptions

__all__ = ["AsmCodec", "AsmMirror", "AsmObserver", "AsmOptions"]
