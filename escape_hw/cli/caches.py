"""Folders for the caches of libraries, where the home directory cannot hold them."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

#: Variables of libraries that keep files in the home directory, and folders for them.
_VARIABLES = {"ASTROPY_CONFIG_DIR": "astropy", "ASTROPY_CACHE_DIR": "astropy", "NUMBA_CACHE_DIR": "numba"}


def provide_caches() -> None:
    """Give Astropy and Numba a private temporary folder if the home directory cannot be written.

    Both fail otherwise; variables that are set already remain. Folders of ESCAPE itself stay in the home
    directory: what cannot be written there is refused with an error.
    """
    home = os.path.expanduser("~")
    if os.access(home, os.R_OK | os.W_OK | os.X_OK):
        return
    try:
        folder = _private_folder()
        for variable, name in _VARIABLES.items():
            if not os.environ.get(variable):
                (folder / name).mkdir(exist_ok=True)
                os.environ[variable] = str(folder / name)
    except OSError:
        # No place for caches at all; what needs one says so.
        return


def _private_folder() -> Path:
    """The same folder in every run, unless another user has made it."""
    folder = Path(tempfile.gettempdir()) / f"escape-caches-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if ours else Path(tempfile.mkdtemp(prefix="escape-caches-"))
