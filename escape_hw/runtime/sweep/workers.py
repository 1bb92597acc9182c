"""Where a sweep's trials run: processes here, or workers of a Dask scheduler."""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from escape_hw.api.concurrency import disable_helper_threads
from escape_hw.errors import CalibrationError, ConfigError
from escape_hw.runtime.sweep.trials import TrialSpec, run_trial

log = logging.getLogger(__name__)

#: One thread for every library of a worker: there are as many workers as cores.
SINGLE_THREAD_VARIABLES = {
    name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
#: Seconds to wait for a Dask scheduler that has gone.
SCHEDULER_TIMEOUT_S = 120.0


class Workers(Protocol):
    """Runs trials somewhere else."""

    @property
    def count(self) -> int:
        """Trials that run at a time."""
        ...

    def submit(self, task: TrialSpec) -> Future[dict[str, Any]]:
        """Run a trial."""
        ...

    def is_lost(self, future: Future[dict[str, Any]]) -> bool:
        """Whether an ended future says nothing of its trial: who ran it has died."""
        ...

    @property
    def is_disconnected(self) -> bool:
        """Whether nobody is left who could end a future."""
        ...

    def restart(self) -> None:
        """Replace what has died; futures from before are worthless."""
        ...

    def close(self) -> None:
        """End the workers at once."""
        ...


class LocalWorkers:
    """Processes on this computer.

    Parameters
    ----------
    count
        How many.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = self._make_pool()

    def _make_pool(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.count, mp_context=context, initializer=_initialise_worker)

    def submit(self, task: TrialSpec) -> Future[dict[str, Any]]:
        """Run a trial; one that cannot even be handed over is lost."""
        # Libraries read these when they are loaded, which a new process does after it has begun.
        before = {name: os.environ.get(name) for name in SINGLE_THREAD_VARIABLES}
        os.environ.update(SINGLE_THREAD_VARIABLES)
        try:
            return self._pool.submit(run_trial, task)
        except BrokenProcessPool as error:
            future: Future[dict[str, Any]] = Future()
            future.set_exception(error)
            return future
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value

    def is_lost(self, future: Future[dict[str, Any]]) -> bool:
        """See :class:`Workers`."""
        return future.cancelled() or isinstance(future.exception(), BrokenProcessPool)

    @property
    def is_disconnected(self) -> bool:
        """See :class:`Workers`; a pool that breaks ends its futures itself."""
        return False

    def restart(self) -> None:
        """See :class:`Workers`."""
        self.close()
        self._pool = self._make_pool()

    def close(self) -> None:
        """See :class:`Workers`."""
        # Python 3.14 has a method for it.
        processes = list((getattr(self._pool, "_processes", None) or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()


class DaskWorkers:
    """Workers of a Dask scheduler, on any number of machines that see the matrices' files.

    Parameters
    ----------
    address
        Such as ``tcp://host:8786``.
    patience_s
        Seconds to wait for a scheduler that has gone.

    Raises
    ------
    ConfigError
        Dask is not installed.
    CalibrationError
        There is no scheduler.
    """

    def __init__(self, address: str, timeout_s: float = SCHEDULER_TIMEOUT_S) -> None:
        try:
            self._dask: Any = importlib.import_module("distributed")
        except ImportError:
            raise ConfigError("--scheduler needs Dask's distributed: pip install 'escape-hw[dask]'") from None
        self.address, self._timeout_s = address, timeout_s
        self._client: Any = None
        self._executor: Executor | None = None
        self._connect()

    @property
    def count(self) -> int:
        """Trials that run at a time: one per worker thread, at least one."""
        try:
            return max(1, int(sum(self._client.nthreads().values())))
        except (OSError, ValueError, RuntimeError, CancelledError):
            return 1

    def _connect(self) -> None:
        deadline = time.monotonic() + self._timeout_s
        while True:
            try:
                self._client = self._dask.Client(self.address, timeout=5, set_as_default=False)
                self._executor = self._client.get_executor(pure=False)
                return
            except (OSError, TimeoutError) as error:
                if time.monotonic() > deadline:
                    raise CalibrationError(
                        f"no Dask scheduler answers at {self.address} for {self._timeout_s:.0f} s; start one "
                        "(dask scheduler) and workers (dask worker --nthreads 1), then resume"
                    ) from error
                log.warning("no Dask scheduler at %s; trying again", self.address)
                time.sleep(1.0)

    def submit(self, task: TrialSpec) -> Future[dict[str, Any]]:
        """Run a trial."""
        if self._executor is None:
            raise RuntimeError("the workers are closed")
        try:
            return self._executor.submit(run_trial, task)
        except self._dask.client.ClosedClientError as error:
            future: Future[dict[str, Any]] = Future()
            future.set_exception(error)
            return future

    def is_lost(self, future: Future[dict[str, Any]]) -> bool:
        """See :class:`Workers`."""
        if future.cancelled():
            return True
        gone = (
            self._dask.KilledWorker, self._dask.comm.CommClosedError, self._dask.client.ClosedClientError,
            self._dask.client.FutureCancelledError, CancelledError,
        )  # fmt: skip
        return isinstance(future.exception(), gone)

    @property
    def is_disconnected(self) -> bool:
        """See :class:`Workers`."""
        return self._client is None or self._client.status in ("closing", "closed")

    def restart(self) -> None:
        """See :class:`Workers`."""
        self.close()
        self._connect()

    def close(self) -> None:
        """See :class:`Workers`."""
        client, self._client, self._executor = self._client, None, None
        if client is not None:
            client.close(timeout=2)


def _initialise_worker() -> None:
    """A new worker process: Ctrl-C is the parent's business, and without a parent there is none."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    disable_helper_threads()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()


def _exit_with_parent(parent: Any) -> None:
    parent.join()
    os._exit(1)
