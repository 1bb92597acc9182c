"""Workers that run the loops of a sweep: processes on this computer, or the workers of a Dask scheduler."""

from __future__ import annotations

import importlib
import logging
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from escape_hw.errors import CalibrationError, ConfigError
from escape_hw.runtime.host.processes import open_process_pool, terminate_pool

log = logging.getLogger(__name__)
T = TypeVar("T")

#: Environment of the workers: one thread for every library, because there is one worker per core.
SINGLE_THREAD_VARIABLES = {
    name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
#: Seconds to wait for a Dask scheduler that does not answer.
SCHEDULER_TIMEOUT_S = 120.0
#: How often one call may lose its worker.
_MAX_DEATHS = 4
#: Seconds between two checks of the connection to a scheduler.
_POLL_S = 1.0


class Workers(ABC):
    """Runs functions elsewhere, again on a new worker when one dies. May be used from several threads."""

    #: Exceptions of a future whose worker died.
    _lost_errors: tuple[type[BaseException], ...] = (CancelledError,)

    def __init__(self) -> None:
        self._lock, self._closed = threading.Lock(), False
        self._executor = self._open_executor()

    @property
    @abstractmethod
    def count(self) -> int:
        """Functions that run at a time."""

    @abstractmethod
    def _open_executor(self) -> Executor: ...

    @abstractmethod
    def _close_executor(self) -> None: ...

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Run a function on a worker, once."""
        return self._executor.submit(function, *arguments)

    def _is_disconnected(self) -> bool:
        """Whether the executor can no longer end its futures."""
        return False

    def run(self, function: Callable[..., T], *arguments: Any) -> T:
        """Run a function on a worker and return its result; its exceptions are raised here.

        Raises
        ------
        CalibrationError
            Its workers died several times in a row, or the pool was closed.
        """
        for _ in range(_MAX_DEATHS + 1):
            try:
                with self._lock:
                    if self._closed:
                        raise CalibrationError("the workers are closed")
                    executor = self._executor
                    future = self.submit(function, *arguments)
                while not wait((future,), timeout=_POLL_S).done:
                    if executor is not self._executor or self._is_disconnected():
                        raise CancelledError
                return future.result()
            except self._lost_errors:
                self._replace(executor)
        raise CalibrationError(
            "the workers die again and again (killed, or out of memory); run fewer of them and resume: "
            "finished trials are kept"
        )

    def _replace(self, executor: Executor) -> None:
        """Open a new executor, unless another thread has done so since."""
        with self._lock:
            if self._executor is executor and not self._closed:
                log.warning("a worker died; what it ran is run again")
                self._close_executor()
                self._executor = self._open_executor()

    def close(self) -> None:
        """End the workers at once."""
        # Set before the lock is taken, so that a thread that waits for a scheduler gives up.
        closed_before, self._closed = self._closed, True
        with self._lock:
            if not closed_before:
                self._close_executor()


class LocalWorkers(Workers):
    """Processes on this computer."""

    _lost_errors = (CancelledError, BrokenProcessPool)
    _executor: Any

    def __init__(self, count: int) -> None:
        self._count = count
        super().__init__()

    @property
    def count(self) -> int:
        """See :class:`Workers`."""
        return self._count

    def _open_executor(self) -> Executor:
        return open_process_pool(self._count)

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """See :class:`Workers`."""
        # Numerical libraries read these variables when a new process loads them.
        with _environment(SINGLE_THREAD_VARIABLES):
            return super().submit(function, *arguments)

    def _close_executor(self) -> None:
        terminate_pool(self._executor)


class DaskWorkers(Workers):
    """Workers of a Dask scheduler (``tcp://host:8786``), on machines that see the matrices' files.

    Raises
    ------
    ConfigError
        Dask is not installed, or the address is not one.
    CalibrationError
        No scheduler answers within :data:`SCHEDULER_TIMEOUT_S` seconds.
    """

    def __init__(self, address: str) -> None:
        try:
            dask: Any = importlib.import_module("distributed")
        except ImportError:
            raise ConfigError("--scheduler needs Dask's distributed: pip install 'escape-hw[dask]'") from None
        self.address, self._dask = address, dask
        self._lost_errors = (
            CancelledError, dask.KilledWorker, dask.comm.CommClosedError, dask.client.ClosedClientError,
            dask.client.FutureCancelledError,
        )  # fmt: skip
        super().__init__()

    @property
    def count(self) -> int:
        """Number of worker threads, at least one."""
        try:
            return max(1, int(sum(self._client.nthreads().values())))
        except (OSError, ValueError, RuntimeError, CancelledError, AttributeError):
            # Another thread is connecting anew; a client without a connection has no scheduler.
            return 1

    def _open_executor(self) -> Executor:
        deadline = time.monotonic() + SCHEDULER_TIMEOUT_S
        try:
            self._dask.comm.get_address_host_port(self.address)
        except ValueError as error:
            raise ConfigError(
                f"--scheduler {self.address}: {error}; it is of the form tcp://host:8786"
            ) from error
        while True:
            try:
                self._client = self._dask.Client(self.address, timeout=5, set_as_default=False)
                executor: Executor = self._client.get_executor(pure=False)
                return executor
            except (OSError, TimeoutError) as error:
                if self._closed or time.monotonic() > deadline:
                    raise CalibrationError(
                        f"no Dask scheduler answers at {self.address} for {SCHEDULER_TIMEOUT_S:.0f} s; start "
                        "one (dask scheduler) and workers (dask worker --nthreads 1), then start or resume "
                        "the sweep"
                    ) from error
                log.warning("no Dask scheduler at %s; trying again", self.address)
                time.sleep(1.0)

    def _is_disconnected(self) -> bool:
        return self._client.status in ("closing", "closed")

    def _close_executor(self) -> None:
        self._client.close(timeout=2)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def open_workers(count: int, scheduler: str | None) -> Workers:
    """Processes on this computer, or the workers of a Dask scheduler when its address is given."""
    return LocalWorkers(count) if scheduler is None else DaskWorkers(scheduler)
