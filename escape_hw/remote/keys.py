"""CURVE keys: who may reach a server from another machine, and which server is the right one.

Every user has one pair of keys, for serving and for connecting alike. Public keys are 40 characters of
Z85 text (ZeroMQ RFC 32), made to be read over the telephone or sent by mail; the secret one never leaves
its file.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import platformdirs
import zmq
from zmq.utils import z85

from escape_hw.errors import ConfigError, StorageError
from escape_hw.io.storage import storage_error
from escape_hw.remote.address import is_loopback

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_ALLOWED, _TRUSTED = "allowed", "servers"


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A user's keys, Z85 text."""

    public: bytes
    secret: bytes


def keys_folder() -> Path:
    """Where this user's keys are."""
    return Path(platformdirs.user_config_dir("escape", appauthor=False)) / "keys"


def make_keys(replace: bool = False) -> KeyPair:
    """Make this user's keys; those that are there stay unless they are to be replaced.

    Raises
    ------
    StorageError
        They cannot be written.
    """
    known = None if replace else own_keys()
    if known is not None:
        return known
    public, secret = zmq.curve_keypair()
    _write(keys_folder() / "own.secret", secret)
    _write(keys_folder() / "own.public", public)
    return KeyPair(public, secret)


def own_keys() -> KeyPair | None:
    """The user's keys, or ``None``: there are none.

    Raises
    ------
    StorageError
        Others may read the secret one.
    ConfigError
        They are damaged.
    """
    path = keys_folder() / "own.secret"
    try:
        if path.stat().st_mode & 0o077:
            raise StorageError(f"{path}: others may read it; make new keys with 'escape keys make --replace'")
        return KeyPair(_check_key(_read(keys_folder() / "own.public")), _check_key(_read(path)))
    except FileNotFoundError:
        return None


def allow(name: str, key: str) -> None:
    """Let the client with this public key in to servers of this user.

    Raises
    ------
    ConfigError
        The name or the key means nothing.
    """
    _write(_file(_ALLOWED, name), _check_key(key.strip().encode()))


def trust(host: str, key: str) -> None:
    """Take the server on a host for the right one when it has this public key.

    Raises
    ------
    ConfigError
        The name or the key means nothing.
    """
    _write(_file(_TRUSTED, host), _check_key(key.strip().encode()))


def forget(name: str) -> bool:
    """Let a client in no longer, and trust no server of that name; false when there was neither."""
    paths = [_file(_ALLOWED, name), _file(_TRUSTED, name)]
    found = [path for path in paths if path.is_file()]
    for path in found:
        path.unlink()
    return bool(found)


def allowed_keys() -> dict[str, bytes]:
    """Public keys of the clients that are let in, by name; read again at every connection."""
    return _read_all(_ALLOWED)


def trusted_keys() -> dict[str, bytes]:
    """Public keys of servers, by host."""
    return _read_all(_TRUSTED)


def server_keys() -> KeyPair:
    """The keys that a server needs for clients on other machines.

    Raises
    ------
    ConfigError
        There are none, or nobody is let in; says what to do.
    """
    own = own_keys()
    if own is None:
        raise ConfigError("clients on other machines need keys; make them with 'escape keys make'")
    if not allowed_keys():
        raise ConfigError("no client is let in; add one with 'escape keys allow NAME KEY'")
    return own


def client_keys(address: str) -> tuple[bytes, bytes, bytes] | None:
    """Server's public, own public and own secret key for an address; ``None`` on the same machine.

    Raises
    ------
    ConfigError
        A key is missing; says which and what to do.
    """
    host = address.removeprefix("tcp://").rpartition(":")[0]
    trusted = trusted_keys().get(host)
    if address.startswith("ipc://") or (is_loopback(host) and trusted is None):
        return None
    own = own_keys()
    if own is None:
        raise ConfigError(
            f"{host} asks for a key; make one with 'escape keys make', and have it allowed there"
        )
    if trusted is None:
        raise ConfigError(f"the key of {host} is not known; add it with 'escape keys trust {host} KEY'")
    return trusted, own.public, own.secret


def keys_hint(address: str, keys: tuple[bytes, bytes, bytes] | None) -> str:
    """What keys may have to do with a server that does not answer: it tells strangers nothing."""
    if address.startswith("ipc://"):
        return ""
    host = address.removeprefix("tcp://").rpartition(":")[0]
    if keys is None:
        return f" If it asks for keys: escape keys trust {host} KEY"
    return (
        f" Does it let this key in (there: escape keys allow NAME '{keys[1].decode()}'), and is its own "
        "still the one that is trusted here (escape keys list)?"
    )


def _file(kind: str, name: str) -> Path:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{name!r}: a name has letters, digits, '.', '_' and '-', at most 64")
    return keys_folder() / kind / f"{name}.key"


def _read_all(kind: str) -> dict[str, bytes]:
    return {path.stem: _check_key(_read(path)) for path in sorted((keys_folder() / kind).glob("*.key"))}


def _check_key(key: bytes) -> bytes:
    try:
        if len(key) == 40 and len(z85.decode(key)) == 32:
            return key
    except (KeyError, ValueError):
        pass  # told below, as every other key that is none
    raise ConfigError(f"{key[:50].decode(errors='replace')!r} is no key; a key has 40 characters")


def _read(path: Path) -> bytes:
    return path.read_bytes().strip()


def _write(path: Path, key: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        temporary = path.with_suffix(".tmp")
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(key + b"\n")
        temporary.replace(path)
    except OSError as error:
        raise storage_error(path, error) from error
