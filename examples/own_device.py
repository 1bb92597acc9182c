"""Write a driver for a mirror, run the contract suite on it, and use it in a system.

Run it with: python examples/own_device.py
"""

import logging

import numpy as np

import escape_hw
from escape_hw.config.layouts import layout_map
from escape_hw.safety.limits import CAUTIOUS_LIMITS

logging.getLogger("escape_hw").setLevel(logging.ERROR)  # the checks provoke failures


class AcmeElectronics:
    """Stand-in for a vendor library: 14-bit channels without any limits."""

    def __init__(self, channels: int) -> None:
        self.counts = np.full(channels, 8192, np.uint16)

    def write(self, counts: np.ndarray) -> None:
        """Drive every channel."""
        self.counts = counts


class AcmeMirror(escape_hw.DeformableMirror):
    """A driver implements four members; guard, ramps, counters and errors are in the base class."""

    def __init__(
        self, serial: str, *, name: str = "acme", limits: escape_hw.MirrorLimits = CAUTIOUS_LIMITS
    ) -> None:
        super().__init__(name, limits)
        self._serial, self._layout = serial, layout_map("circle-11")
        self._electronics: AcmeElectronics | None = None

    @classmethod
    def from_section(cls, section, context) -> "AcmeMirror":
        """The mirror of a system; a package names the class in its entry points ``escape.devices``."""
        return cls(section.serial, name=context.name, limits=section.limits.to_limits())

    @property
    def info(self) -> escape_hw.DMInfo:
        """Identity and geometry."""
        rows, columns = np.nonzero(self._layout)
        positions_m = 1.5e-3 * (np.stack([columns, rows], axis=1) - (len(self._layout) - 1) / 2)
        return escape_hw.DMInfo(
            model="Acme 97", serial=self._serial, n_act=len(positions_m), layout=self._layout,
            positions_m=positions_m, stroke_m=2.0e-6, simulated=True,
        )  # fmt: skip

    def _open(self) -> None:
        self._electronics = AcmeElectronics(self.info.n_act)  # load the vendor library here

    def _close(self) -> None:
        self._electronics = None

    def _send(self, command: np.ndarray) -> None:
        # The command is float64 (n_act,), fractions of full stroke, within every limit.
        self._electronics.write(np.rint(8192 + 8191 * command).astype(np.uint16))


if __name__ == "__main__":
    # Level 1 moves by at most a percent, for the first test of a real mirror; level 3 uses the full range
    # within the limits.
    results = escape_hw.testing.run_checks(lambda: AcmeMirror("A-0001"), max_level=3)
    for result in results:
        print(f"{result.outcome:>8}  {result.check}  {result.message}".rstrip())

    # Alone, by the name of its driver.
    escape_hw.register_device("acme", AcmeMirror)
    with escape_hw.open_device("acme", serial="A-0001") as dm:
        shape = dm.flat
        shape[48] = 0.05
        print(dm.send(shape).guard)

    # In a system, so that a configuration or --set can name it. This mirror is not in the simulated
    # beam; see docs/devices/add-a-driver.md.
    with escape_hw.open_system("razor-shwfs", set=["devices.dm.sim_driver=acme"]) as bench:
        report = bench.dm.send(np.full(bench.dm.info.n_act, 0.9))
        print(f"{bench.dm.info.model}: requested 0.9, sent {report.sent.max():.3f}; {report.guard}")
