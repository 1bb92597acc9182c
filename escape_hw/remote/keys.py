"""CURVE keys that authenticate servers and clients on different computers.

Every user has one key pair, for serving and for connecting. Public keys are 40 characters of Z85 text
(ZeroMQ RFC 32); the secret key stays in its file.
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
    """A user's key pair, Z85 text."""

    public: bytes
    secret: bytes


def keys_folder() -> Path:
    """Folder of this user's keys."""
    return Path(platformdirs.user_config_dir("escape", appauthor=False)) / "keys"


def make_keys(replace: bool = False) -> KeyPair:
    """Create this user's key pair; an existing one is kept unless ``replace``.

    Raises
    ------
    StorageError
        The files cannot be written.
    """
    known = None if replace else own_keys()
    if known is not None:
        return known
    public, secret = zmq.curve_keypair()
    _write(keys_folder() / "own.secret", secret)
    _write(keys_folder() / "own.public", public)
    return KeyPair(public, secret)


def own_keys() -> KeyPair | None:
    """The user's key pair; ``None`` when there is none.

    Raises
    ------
    StorageError
        Other users can read the secret key.
    ConfigError
        A file is damaged.
    """
    path = keys_folder() / "own.secret"
    try:
        if path.stat().st_mode & 0o077:
            raise StorageError(
                f"{path}: other users can read it; make new keys with 'escape keys make --replace'"
            )
        return KeyPair(_check_key(_read(keys_folder() / "own.public")), _check_key(_read(path)))
    except FileNotFoundError:
        return None


def allow(name: str, key: str) -> None:
    """Allow the client with this public key to connect to servers of this user.

    Raises
    ------
    ConfigError
        The name or the key is malformed.
    """
    _write(_file(_ALLOWED, name), _check_key(key.strip().encode()))


def trust(host: str, key: str) -> None:
    """Trust the server on a host if it has this public key.

    Raises
    ------
    ConfigError
        The name or the key is malformed.
    """
    _write(_file(_TRUSTED, host), _check_key(key.strip().encode()))


def remove(name: str) -> bool:
    """Remove an allowed client or a trusted server; false when there is none of that name."""
    paths = [_file(_ALLOWED, name), _file(_TRUSTED, name)]
    found = [path for path in paths if path.is_file()]
    for path in found:
        path.unlink()
    return bool(found)


def allowed_keys() -> dict[str, bytes]:
    """Public keys of the allowed clients by name, read from the files."""
    return _read_all(_ALLOWED)


def trusted_keys() -> dict[str, bytes]:
    """Public keys of the trusted servers by host."""
    return _read_all(_TRUSTED)


def server_keys() -> KeyPair:
    """Key pair of a server for clients on other computers.

    Raises
    ------
    ConfigError
        There is no key pair, or no client is allowed.
    """
    own = own_keys()
    if own is None:
        raise ConfigError("clients on other computers need keys; make them with 'escape keys make'")
    if not allowed_keys():
        raise ConfigError("no client is allowed; add one with 'escape keys allow NAME KEY'")
    return own


def client_keys(address: str) -> tuple[bytes, bytes, bytes] | None:
    """Server's public, own public and own secret key for an address; ``None`` on the same computer.

    Raises
    ------
    ConfigError
        A key is missing.
    """
    host = address.removeprefix("tcp://").rpartition(":")[0]
    trusted = trusted_keys().get(host)
    if address.startswith("ipc://") or (is_loopback(host) and trusted is None):
        return None
    own = own_keys()
    if own is None:
        raise ConfigError(
            f"{host} requires a key; make one with 'escape keys make', and have it allowed there"
        )
    if trusted is None:
        raise ConfigError(f"the key of {host} is unknown; add it with 'escape keys trust {host} KEY'")
    return trusted, own.public, own.secret


def keys_hint(address: str, keys: tuple[bytes, bytes, bytes] | None) -> str:
    """Hint for an error message: a server does not reply to clients without an allowed key."""
    if address.startswith("ipc://"):
        return ""
    host = address.removeprefix("tcp://").rpartition(":")[0]
    if keys is None:
        return f". If it requires keys: escape keys trust {host} KEY"
    return (
        f". Check that it allows this key (there: escape keys allow NAME '{keys[1].decode()}'), and that its "
        "own key is the one that is trusted here (escape keys list)."
    )


def _file(kind: str, name: str) -> Path:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{name!r} is not a valid name; use at most 64 letters, digits, '.', '_' and '-'")
    return keys_folder() / kind / f"{name}.key"


def _read_all(kind: str) -> dict[str, bytes]:
    return {path.stem: _check_key(_read(path)) for path in sorted((keys_folder() / kind).glob("*.key"))}


def _check_key(key: bytes) -> bytes:
    try:
        if len(key) == 40 and len(z85.decode(key)) == 32:
            return key
    except (KeyError, ValueError):
        pass  # reported below
    raise ConfigError(f"{key[:50].decode(errors='replace')!r} is not a key; a key has 40 characters")


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
