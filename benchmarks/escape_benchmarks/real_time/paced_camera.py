"""A process that plays a camera: the frames of a file go round in a ring, at a rate.

It ends when its standard input does.
"""

from __future__ import annotations

import sys
import threading
import time

import numpy as np

from escape_hw.streams.realtime import PRIORITY, realtime_thread
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name

#: Frames that the ring keeps, as the buffers of a camera's driver would.
SLOTS = 64


def _segment_name() -> str:
    return segment_name("perf", "frames")


def main() -> None:
    """Write frames until nobody wants any."""
    frames, rate = np.load(sys.argv[1], allow_pickle=False), float(sys.argv[2])
    ended = threading.Event()

    def wait_for_stdin_end() -> None:
        sys.stdin.buffer.read()
        ended.set()

    threading.Thread(target=wait_for_stdin_end, daemon=True).start()
    # A camera's clock waits for no process; what was not allowed, the loop's own attempt tells.
    with realtime_thread(priority=PRIORITY + 1), RingWriter(_segment_name(), frames[0].nbytes, SLOTS) as ring:
        print(ring.name, flush=True)
        index, due = 0, time.perf_counter()
        while not ended.is_set():
            now = time.perf_counter()
            # After a long halt it goes on from there, as the peer's does.
            due = now if now - due > 0.1 else due
            if due > now:
                time.sleep(due - now)
            due += 1 / rate
            ring.write(frames[index % len(frames)], index, time.monotonic_ns())
            index += 1


if __name__ == "__main__":
    main()
