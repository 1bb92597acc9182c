"""A process that emulates a camera: writes the frames of a file to a ring, cyclically, at a given rate.

It ends when its standard input is closed.
"""

from __future__ import annotations

import sys
import threading
import time

import numpy as np

from escape_hw.streams.realtime import PRIORITY, realtime_thread
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name

#: Frames that the ring holds, as the buffers of a camera's driver do.
SLOTS = 64


def _segment_name() -> str:
    return segment_name("perf", "frames")


def main() -> None:
    """Write frames until stopped."""
    frames, rate = np.load(sys.argv[1], allow_pickle=False), float(sys.argv[2])
    ended = threading.Event()

    def wait_for_stdin_end() -> None:
        sys.stdin.buffer.read()
        ended.set()

    threading.Thread(target=wait_for_stdin_end, daemon=True).start()
    # Above the loop's priority, as a camera's clock is; a missing permission shows in the notes of the loop.
    with realtime_thread(priority=PRIORITY + 1), RingWriter(_segment_name(), frames[0].nbytes, SLOTS) as ring:
        print(ring.name, flush=True)
        index, due = 0, time.perf_counter()
        while not ended.is_set():
            now = time.perf_counter()
            # After a long halt it continues from the present time, as the peer's camera does.
            due = now if now - due > 0.1 else due
            if due > now:
                time.sleep(due - now)
            due += 1 / rate
            ring.write(frames[index % len(frames)], index, time.monotonic_ns())
            index += 1


if __name__ == "__main__":
    main()
