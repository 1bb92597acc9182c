"""Real servers for sweeps: PostgreSQL from the system's packages, and a Dask scheduler with workers."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def postgres_binaries() -> Path | None:
    """Folder of ``initdb`` and ``postgres``, wherever the system keeps them."""
    found = shutil.which("initdb")
    if found:
        return Path(found).resolve().parent
    versions = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return versions[-1].parent if versions else None


class Postgres:
    """A PostgreSQL server of its own, in a folder of its own."""

    def __init__(self, binaries: Path) -> None:
        # Below a folder that the server's user may pass, with a name short enough for a socket.
        self._binaries, self.folder, self.port = binaries, Path(tempfile.mkdtemp(prefix="pg")), free_port()
        # The server refuses to run as root.
        self._user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        if self._user:
            shutil.chown(self.folder, "postgres")
        self._call("initdb", "-D", str(self.folder / "data"), "-U", "escape", "-A", "trust", "-E", "UTF8")
        self._server: subprocess.Popen[bytes] | None = None
        self.start()
        self._call("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "escape", "sweeps")

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://escape@127.0.0.1:{self.port}/sweeps"

    def _call(self, name: str, *arguments: str) -> str:
        words = [*self._user, str(self._binaries / name), *arguments]
        return subprocess.run(words, check=True, capture_output=True, text=True, cwd="/").stdout

    def start(self) -> None:
        """Start it; after a kill, as soon as the killed one's children have ended."""
        words = [
            *self._user, str(self._binaries / "postgres"), "-D", str(self.folder / "data"),
            "-c", f"port={self.port}", "-c", "listen_addresses=127.0.0.1",
            "-c", f"unix_socket_directories={self.folder}",
        ]  # fmt: skip
        deadline = time.monotonic() + 60
        while True:
            self._server = subprocess.Popen(
                words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/"
            )
            while self._server.poll() is None:
                try:
                    self._call("pg_isready", "-h", "127.0.0.1", "-p", str(self.port))
                    return
                except subprocess.CalledProcessError:
                    time.sleep(0.1)
            assert time.monotonic() < deadline, "PostgreSQL does not start"
            time.sleep(0.5)

    def kill(self) -> None:
        """End the server at once, as a crash would."""
        assert self._server is not None
        first_line = (self.folder / "data" / "postmaster.pid").read_text().split()[0]
        os.kill(int(first_line), signal.SIGKILL)
        self._server.wait(timeout=30)

    def close(self) -> None:
        if self._server is not None and self._server.poll() is None:
            self.kill()
        shutil.rmtree(self.folder, ignore_errors=True)

    def ask(self, query: str) -> list[str]:
        """Rows of a query, as text."""
        where = ("-h", "127.0.0.1", "-p", str(self.port), "-U", "escape", "-d", "sweeps")
        return self._call("psql", *where, "-At", "-c", query).splitlines()


class Dask:
    """A Dask scheduler with two workers of one thread each."""

    def __init__(self) -> None:
        self.port = free_port()
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []
        self.start()

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start(self) -> None:
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.scheduler = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", str(self.port),
             "--no-dashboard", "--host", "127.0.0.1"], **quiet,
        )  # fmt: skip
        for _ in range(2):
            self.add_worker()

    def add_worker(self) -> None:
        self.workers.append(
            subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1",
                 "--no-nanny", "--no-dashboard"],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
        )  # fmt: skip

    def kill_scheduler(self) -> None:
        assert self.scheduler is not None
        self.scheduler.kill()
        self.scheduler.wait()

    def close(self) -> None:
        for process in (self.scheduler, *self.workers):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()
