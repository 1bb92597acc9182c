"""Write a driver for a mirror of your own, let the contract suite check it, and use it in a system.

Run it with: python examples/own_device.py
"""

import logging

import numpy as np

import escape_hw

logging.getLogger("escape_hw").setLevel(logging.ERROR)  # the checks provoke failures; no need to hear of each


class AcmeElectronics:
    """Stands in for a vendor's library: 14-bit channels, and it lets you send anything at all."""

    def __init__(self, channels: int) -> None:
        self.counts = np.full(channels, 8192, np.uint16)

    def write(self, counts: np.ndarray) -> None:
        """Drive every channel."""
        self.counts = counts


class AcmeMirror(escape_hw.DeformableMirror):
    """A driver fills in four things; guard, ramps, counters and errors come with the base class."""

    def __init__(self, name: str, layout: np.ndarray, limits: escape_hw.MirrorLimits) -> None:
        super().__init__(name, limits)
        self._layout = layout
        self._electronics: AcmeElectronics | None = None

    @property
    def info(self) -> escape_hw.DMInfo:
        """Identity and geometry."""
        rows, columns = np.nonzero(self._layout)
        places = 1.5e-3 * (np.stack([columns, rows], axis=1) - (len(self._layout) - 1) / 2)
        return escape_hw.DMInfo(
            model="Acme 97", serial="A-0001", n_act=len(places), layout=self._layout,
            positions_m=places, stroke_m=2.0e-6, simulated=True,
        )  # fmt: skip

    def _open(self) -> None:
        self._electronics = AcmeElectronics(self.info.n_act)  # import a vendor's library here, not above

    def _close(self) -> None:
        self._electronics = None

    def _send(self, command: np.ndarray) -> None:
        # Checked already: float64 (n_act,), fractions of full stroke, within every limit.
        self._electronics.write(np.rint(8192 + 8191 * command).astype(np.uint16))


def make_mirror(name: str, config, shared) -> AcmeMirror:
    """What a package of your own offers under [project.entry-points."escape.devices"]."""
    dm = config.devices.dm
    return AcmeMirror(name, dm.actuator_map(), dm.limits.to_limits())


if __name__ == "__main__":
    # The contract suite is what our own drivers have to pass. Level 1 moves by a percent at most, as you
    # would want with a real mirror the first time; level 3 uses the full range that the limits allow.
    config = escape_hw.load_system("razor-shwfs")
    results = escape_hw.testing.run_checks(lambda: make_mirror("acme", config, {}), max_level=3)
    for result in results:
        print(f"{result.outcome:>8}  {result.check}  {result.message}".rstrip())

    # In a script one line registers it; then a configuration, or --set, may name it. No light falls on this
    # one: how a mirror joins the simulated beam stands in docs/devices/add-a-driver.md.
    escape_hw.register_device("acme", make_mirror)
    with escape_hw.open_system("razor-shwfs", set=["devices.dm.sim_driver=acme"]) as bench:
        report = bench.dm.send(np.full(bench.dm.info.n_act, 0.9))
        print(
            f"{bench.dm.info.model}: asked for 0.9, sent {report.sent.max():.3f}; the guard: {report.guard}"
        )
