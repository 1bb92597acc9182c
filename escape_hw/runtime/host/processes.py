"""Pools of worker processes that end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from escape_hw.api.concurrency import disable_helper_threads


def open_process_pool(count: int, *, helper_threads: bool = False) -> ProcessPoolExecutor:
    """A pool of spawned processes that ignore Ctrl-C and exit with this process.

    ``helper_threads`` allows simulations to use threads of their own.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        count, mp_context=context, initializer=_initialise_worker, initargs=(helper_threads,)
    )


def terminate_pool(pool: ProcessPoolExecutor) -> None:
    """Terminate the processes of a pool without waiting for what they run."""
    # Python 3.14 has a method for it.
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def _initialise_worker(helper_threads: bool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if not helper_threads:
        disable_helper_threads()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()


def _exit_with_parent(parent: Any) -> None:
    parent.join()
    os._exit(1)
