"""Write a procedure, here a measurement of the linear range of the sensor.

A procedure is a generator that moves hardware, yields progress, and returns a result. The function that runs
it shows progress and handles Ctrl-C.

Run it with: python examples/own_procedure.py
"""

import numpy as np

import escape_hw
from escape_hw.calibration.modes.bases import build_modal_basis


def linear_range(
    bench: escape_hw.System, mode: int, amplitudes: np.ndarray, frames: int = 30
) -> escape_hw.Procedure[np.ndarray]:
    """Response of the sensor to one mode at several amplitudes, relative to the first.

    Parameters
    ----------
    mode
        Index in the modal basis.
    amplitudes
        Rms surface as fraction of full stroke.
    frames
        Frames averaged per push and per pull.

    Returns
    -------
    ndarray, same shape as ``amplitudes``
        1 in the linear range.
    """
    setup = yield from escape_hw.find_sensor(bench, frames=20)  # a procedure can call other procedures
    slopes_of = bench.slopes_of(setup.grid)
    shape = build_modal_basis(bench)[:, mode]
    report = escape_hw.Reporter("linear range", len(amplitudes), "amplitude")
    columns = []
    try:
        for done, amplitude in enumerate(amplitudes, start=1):
            push, pull = (mean_slopes(bench, slopes_of, sign * amplitude * shape, frames) for sign in (1, -1))
            columns.append((push - pull) / (2 * amplitude))
            yield report(done, amplitude=amplitude)  # Ctrl-C takes effect here, never inside a transfer
    finally:
        bench.dm.flatten()  # also after an abort or an error
    reference = columns[0]
    return np.array([reference @ column / (reference @ reference) for column in columns])


def mean_slopes(bench: escape_hw.System, slopes_of, command: np.ndarray, frames: int) -> np.ndarray:
    """Mean slopes with this shape on the mirror, after settling."""
    bench.dm.send(command)
    for _ in range(4):
        bench.wfs.next_frame()
    return np.mean([slopes_of(bench.wfs.next_frame().data) for _ in range(frames)], axis=0)


if __name__ == "__main__":
    amplitudes = np.geomspace(0.02, 0.32, 9)
    with escape_hw.open_system("razor-shwfs") as bench:
        bench.screen.set(inserted=False)
        response = bench.run(linear_range(bench, mode=5, amplitudes=amplitudes), progress=True)
    for amplitude, value in zip(amplitudes, response, strict=True):
        print(f"{amplitude:6.3f} of full stroke: response {value:.3f} {'=' * round(40 * value)}")
