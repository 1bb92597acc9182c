"""Adaptive secondary mirror behind a TCP link: messages, codec, link, driver, observer.

Exports ``AsmMirror``, ``AsmOptions``, ``AsmObserver``, ``AsmCodec``. The emulator is in
``escape_sim.emulators``.
"""
