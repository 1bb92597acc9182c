"""A run's folder: configuration, log, products, result and report in one dated place."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import platformdirs

from escape_hw.errors import EscapeError, ProductError, StorageError
from escape_hw.io.documents import dumps
from escape_hw.io.provenance import get_git_state, get_software_version
from escape_hw.io.storage import check_writable, make_folder, storage_error, write_atomic

#: Free space required before a run, in bytes; a run's products are a few megabytes.
MIN_FREE_BYTES = 50_000_000
LOG_FILE = "run.log"
RESULT_FILE = "result.json"

log = logging.getLogger(__name__)


def default_runs_folder() -> Path:
    """Default folder of runs: ``runs`` in the user's data directory."""
    return Path(platformdirs.user_data_dir("escape", appauthor=False)) / "runs"


def dated_folder(runs: Path, *names: str) -> Path:
    """Path of a new folder ``RUNS/DATE/TIME_NAME...`` in local time, since these names are for people."""
    now = datetime.now().astimezone()
    return runs / f"{now:%Y-%m-%d}" / "_".join((f"{now:%H%M%S}", *map(_sanitise_name, names)))


#: Name of a folder of :func:`dated_folder`; a server appends the number of the run.
_RUN_NAME = re.compile(r"(?P<time>\d{6})_(?P<system>.+)_(?P<kind>[^_]+?)(-(?P<number>\d+))?")


def find_runs(runs: Path) -> Iterator[Path]:
    """The dated run folders under ``runs``, the newest first."""
    for day in sorted(runs.glob("[0-9]*-[0-9]*-[0-9]*"), reverse=True):
        yield from sorted((one for one in day.glob("*_*") if one.is_dir()), reverse=True)


def last_run_number(runs: Path, system: str) -> int:
    """Largest number of a server's runs of a system under ``runs``; 0 if there is none."""
    names = (_RUN_NAME.fullmatch(folder.name) for folder in find_runs(runs))
    return max(
        (int(name["number"]) for name in names if name and name["number"] and name["system"] == system),
        default=0,
    )


def run_time(folder: Path) -> str:
    """Time at which a run or recording began, by the name of its folder: ``21:45:30``."""
    return ":".join(folder.name[k : k + 2] for k in (0, 2, 4))


def run_label(folder: Path) -> str:
    """Name of a run for people: ``docrime-17`` for a server's run, else ``2026-11-22 214530 docrime``."""
    name = _RUN_NAME.fullmatch(folder.name)
    if name is None:
        return folder.name
    kind = name["kind"].removeprefix("calibrate-")
    if name["number"]:
        return f"{kind}-{name['number']}"
    return f"{folder.parent.name} {name['time']} {kind}"


class RunFolder:
    """The folder of one run; as a context manager it also keeps ``run.log``.

    Parameters
    ----------
    system, kind
        Name of the system and of what is done; both become part of the folder's name.
    out
        The folder itself; ``None`` makes a new dated one under :func:`default_runs_folder`. A folder that
        already holds a run is left alone and a sibling with a number is made.

    Attributes
    ----------
    path
        The folder.
    requested_path
        The requested folder, when it already contained files and another one is used.

    Raises
    ------
    StorageError
        The folder has no name of its own (``.``, ``/``), is a file, or cannot be created or written. Raised
        before anything moves.
    """

    def __init__(self, system: str, kind: str, out: Path | str | None = None) -> None:
        self.system, self.kind = system, kind
        if out is None:
            requested = dated_folder(default_runs_folder(), system, kind)
        else:
            requested = Path(out).expanduser()
            if requested.name in ("", ".."):
                # An empty text is the current folder, too.
                raise StorageError(
                    f"'{out}' (--out) gives the folder of the run no name; name a new one, such as "
                    f"{requested / kind}"
                )
            requested = requested.absolute()
        self.path = _create_unique_folder(requested)
        self.requested_path = requested if out is not None and self.path != requested else None
        self.products: dict[str, Path] = {}
        self._handler: logging.Handler | None = None
        check_writable(self.path, MIN_FREE_BYTES)

    def __enter__(self) -> Self:
        """Start the log."""
        path = self.path / LOG_FILE
        try:
            handler = logging.FileHandler(path, encoding="utf-8")
        except OSError as error:
            raise storage_error(path, error) from error
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        handler.setLevel(logging.INFO)
        package = logging.getLogger("escape_hw")
        self._level = package.level
        package.setLevel(logging.INFO)
        for name in ("escape_hw", "escape_sim", "escape_drivers"):
            logging.getLogger(name).addHandler(handler)
        self._handler = handler
        log.info("%s on %s, ESCAPE %s (%s)", self.kind, self.system, get_software_version(), get_git_state())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log; an error that ends the run is written into it first."""
        if isinstance(error, EscapeError):
            log.error("the run ended: %s: %s", type(error).__name__, error)
        elif error is not None:
            log.error("the run ended with an unexpected error", exc_info=error)
        if self._handler is not None:
            for name in ("escape_hw", "escape_sim", "escape_drivers"):
                logging.getLogger(name).removeHandler(self._handler)
            logging.getLogger("escape_hw").setLevel(self._level)
            self._handler.close()
            self._handler = None

    def location_fields(self) -> dict[str, Any]:
        """Fields of a document: the folder used, and the requested one if different."""
        return {
            "folder": str(self.path),
            "folder_asked": None if self.requested_path is None else str(self.requested_path),
        }

    def file(self, name: str) -> Path:
        """Path of a file in this folder."""
        return self.path / name

    def add_product(self, name: str, path: Path) -> Path:
        """Remember a product under a name that ``result.json`` lists."""
        self.products[name] = path
        log.info("product %s: %s", name, path)
        return path

    def write_config(self, text: str) -> Path:
        """Write ``config.toml``, the whole configuration of the run."""
        return self.write_text("config.toml", text)

    def write_text(self, name: str, text: str) -> Path:
        """Write a text file atomically.

        Raises
        ------
        StorageError
            The file cannot be written.
        """
        path = self.file(name)
        write_atomic(path, text.encode())
        return path

    def write_result(self, document: Mapping[str, Any]) -> Path:
        """Write ``result.json`` with the products' paths relative to the folder, so that it can be moved."""
        products = {name: str(path.relative_to(self.path)) for name, path in self.products.items()}
        return self.write_text(RESULT_FILE, dumps({**document, "products": products}) + "\n")


#: Keys of ``result.json`` in files of version 0.1.0, and their names today.
_RENAMED_KEYS = {
    "planted": "injected", "planted_course": "injected_course", "planted_end": "injected_end",
    "planted_note": "injected_note", "asked": "request",
}  # fmt: skip


def read_result(folder: Path | str) -> dict[str, Any]:
    """The ``result.json`` of a run folder, products as absolute paths.

    Raises
    ------
    ProductError
        No run folder, or its ``result.json`` is damaged.
    """
    path = Path(folder) / RESULT_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        log = path.with_name(LOG_FILE)
        hint = f"the run has no result, see {log}" if log.is_file() else "is this a run folder?"
        raise ProductError(f"{path}: cannot be read ({error.strerror or error}); {hint}") from error
    except (ValueError, RecursionError) as error:
        raise ProductError(f"{path}: damaged; not a JSON document ({error})") from error
    if not isinstance(document, dict) or not isinstance(document.get("products"), dict):
        raise ProductError(f"{path}: it lists no products")
    for old, new in _RENAMED_KEYS.items():
        if old in document:
            document.setdefault(new, document.pop(old))
    home = path.parent.absolute()
    document["products"] = {str(name): home / str(file) for name, file in document["products"].items()}
    return document


def _sanitise_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.") or "run"


def _create_unique_folder(requested: Path) -> Path:
    """Make the folder, or the first free sibling when it already holds a run (safe between processes)."""
    make_folder(requested.parent)
    if requested.exists() and not requested.is_dir():
        raise StorageError(f"{requested}: is a file, not a folder; choose another name (--out)")
    for number in range(1, 10_000):
        path = requested if number == 1 else requested.with_name(f"{requested.name}-{number}")
        try:
            path.mkdir(exist_ok=True)
            if any(path.iterdir()):
                continue
            # Only one of several that find the folder empty can create the log.
            (path / LOG_FILE).touch(exist_ok=False)
        except FileExistsError:
            continue
        except OSError as error:
            raise storage_error(path, error) from error
        return path
    raise storage_error(requested, FileExistsError(17, "too many folders with that name"))
